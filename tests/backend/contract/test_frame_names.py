"""Frame numbers in file names: which digits form the number, and which names belong together."""

import pytest

from torch_backend.contract import file_as_blender_counts, matching_files, numbered_files

FRAMES = range(1, 17)


def of(template, frames=FRAMES):
    return [template.format(n=n, time=41 * n, seed=7919 * n % 101, back=17 - n) for n in frames]


@pytest.mark.parametrize(
    ("template", "pattern"),
    [
        ("frame-{n:04d}.jpg", "frame-####.jpg"),
        ("2026-11-28-{n:04d}.jpg", "2026-11-28-####.jpg"),
        ("clip_v01-{n:04d}.jpg", "clip_v01-####.jpg"),
        ("photo ({n}).jpg", "photo (#).jpg"),
        ("a[b]{{c}}+#({n:03d})+.png", "a[b]{c}+#(###)+.png"),
        ("frame_{n:04d}_left.jpg", "frame_####_left.jpg"),
        ("f_{n:04d}_v2.png", "f_####_v2.png"),
        ("{n}.png", "#.png"),
        ("-{n:05d}.png", "-#####.png"),
        ("shot.{n:04d}", "shot.####"),
        ("f_{n:04d}_t{time}.png", "f_####_t*.png"),
        ("seed{seed}_{n:04d}.png", "seed*_####.png"),
        ("a{n}_b{n}.png", "a*_b#.png"),
    ],
)
def test_the_number_is_the_one_that_counts_the_frames(template, pattern):
    names = of(template)
    (found,) = numbered_files(reversed(names))
    assert (found.pattern, found.twice) == (pattern, None)
    assert list(found.files.items()) == list(zip(FRAMES, names))
    assert found.has_second_number == ("*" in pattern)


def test_endings_of_one_format_make_one_sequence():
    names = [f"f_{n:04d}.{end}" for n, end in zip(FRAMES, ["jpg", "JPG", "jpeg", "JPEG"] * 4)]
    (found,) = numbered_files(names)
    assert list(found.files.values()) == names
    assert [len(s.files) for s in numbered_files([*of("f_{n}.tif", range(8)), *of("f_{n}.TIFF", range(8, 16))])] == [16]


@pytest.mark.parametrize(
    ("templates", "patterns"),
    [
        (["left_{n:04d}.png", "right_{n:04d}.png"], ["left_####.png", "right_####.png"]),
        (["s_v1_{n:04d}.png", "s_v2_{n:04d}.png"], ["s_v1_####.png", "s_v2_####.png"]),
        (["cam0/{n:04d}.png", "cam1/{n:04d}.png"], ["cam0/####.png", "cam1/####.png"]),
        (["f_{n:04d}_0.png", "f_{n:04d}_1.png"], ["f_####_0.png", "f_####_1.png"]),
        (["f_{n:04d}.jpg", "f_{n:04d}.png"], ["f_####.jpg", "f_####.png"]),
        (["f_{n:04d}.jpg", "f_{n:04d}.JPG"], ["f_####.JPG", "f_####.jpg"]),
        (["a{n}_b{back}.png"], ["a#_b*.png", "a*_b#.png"]),
    ],
)
def test_several_sequences_are_kept_separate(templates, patterns):
    found = numbered_files([name for template in templates for name in of(template)])
    assert [s.pattern for s in found] == patterns
    assert all(list(s.files) == list(FRAMES) for s in found)


def test_cameras_that_took_turns_are_no_one_sequence():
    found = numbered_files([f"cam{n % 2}_{n:04d}.png" for n in FRAMES])
    assert [(s.pattern, len(s.files)) for s in found] == [("cam0_####.png", 8), ("cam1_####.png", 8)]


def test_duplicate_frame_numbers_are_reported():
    assert numbered_files(["f_1.png", "f_2.png", "f_02.png"])[0].twice == ("f_02.png", "f_2.png")


def test_names_without_numbers_belong_to_none_and_a_single_one_counts_by_its_last():
    assert numbered_files(["poster.jpg", "README"]) == []
    assert numbered_files(["cam2_7.png"])[0].files == {7: "cam2_7.png"}


@pytest.mark.parametrize(
    ("pattern", "found"),
    [
        ("v1.####.png", ["v1.####.png"]),
        ("v1.%04d.PNG", ["v1.####.png"]),
        ("v1.@@@.png", ["v1.####.png"]),
        ("v1.%d.png", ["v1.####.png"]),
        ("v1*", ["v1.####.png"]),
        ("v#.####.png", ["v1.####.png", "v2.####.png"]),
        ("*.####.png", ["v1.####.png", "v2.####.png"]),
        ("v3.####.png", []),
        ("v1.####.exr", []),
    ],
)
def test_what_a_pattern_means(pattern, found):
    names = [*of("v1.{n:04d}.png"), *of("v2.{n:04d}.png")]
    assert [s.pattern for s in matching_files(names, pattern)] == found


def test_pattern_may_contain_special_characters_and_selects_the_number():
    names = of("take#2 [a]{{b}}+(c)_{n}.png")
    assert list(matching_files(names, "take#2 [a]{b}+(c)_####.png")[0].files.values()) == names
    both = of("a{n}_b{back}.png")
    assert matching_files(both, "a*_b#.png")[0].files[1] == "a16_b1.png"
    assert matching_files(both, "a#_b*.png")[0].files[1] == "a1_b16.png"


def test_what_blender_takes_for_a_frame():
    assert file_as_blender_counts("photo (1).jpg", 12) == "photo (12).jpg"
    assert file_as_blender_counts("f_0001_v2.png", 3) == "f_0001_v3.png"
    assert file_as_blender_counts("poster.png", 3) == "poster.png"
