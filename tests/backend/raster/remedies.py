"""Takes each remedy out of the rasteriser, one at a time, and asks whether a test notices.

    python tests/backend/raster/remedies.py [WORD ...]      only remedies whose name, file or test holds a WORD

Works on a copy in a temporary folder. First every named test must pass on the unchanged copy; then, for each remedy,
its text is replaced and its test must fail. Exit code 1 if one does not notice, or if a text is no longer there, or if
a test that stands for a known failure has no remedy here. test_hard_cases.py checks the last two.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
COPIED = ("torch_backend", "tests", "benchmarks", "examples", "pyproject.toml")


@dataclass(frozen=True)
class Remedy:
    """A text of the rasteriser that keeps a hard case harmless, and the test that knows."""

    name: str
    file: str
    """Within torch_backend; a folder of kernels stands for all of its files."""
    old: str
    new: str
    test: str
    """Function in test_hard_cases.py, or file::function."""
    body: str
    """Word in the test's id; empty for a test that has no bodies."""
    also: tuple[tuple[str, str], ...] = ()
    """More (old, new): what would catch the same thing once more."""

    @property
    def changes(self) -> tuple[tuple[str, str], ...]:
        return ((self.old, self.new), *self.also)

    @property
    def full_test(self) -> str:
        """file::function."""
        return self.test if "::" in self.test else f"test_hard_cases.py::{self.test}"

    @property
    def node(self) -> str:
        return f"tests/backend/raster/{self.full_test}"

    def texts(self, folder: Path) -> dict[Path, str]:
        """Files of the copy of torch_backend in `folder` that may hold the text, and what they hold."""
        path = folder / self.file
        files = sorted(path.glob("*.c*")) if path.is_dir() else [path]
        return {file: file.read_text(encoding="utf-8") for file in files}

    @property
    def command(self) -> list[str]:
        words = {"": "", "reference": "reference and not reference32"}.get(self.body, self.body)
        return [self.node, *(["-k", words] if words else [])]


CPU, REFERENCE, CUDA, API = "raster/kernels/cpu", "raster/reference.py", "raster/kernels/cuda", "raster/api.py"
CPU_HOST = "raster/cpu.py"
_NON_FINITE = "test_non_finite_gaussian_is_culled_and_the_others_stay"
_ENORMOUS = "test_infinite_and_enormous_scales_are_culled"
_FOOTPRINT = "test_footprint_beyond_the_frustum_is_bounded_by_the_clamp"
_POINT = "test_a_point_is_as_wide_as_the_low_pass"
_FLOOR = "test_a_point_keeps_half_a_percent_of_its_opacity_when_antialiased"
_BLACK = "test_black_harmonics_can_become_brighter_but_not_darker"
_LENGTH = "test_length_of_a_quaternion_does_not_matter"
_STOP = "test_pixel_stops_once_it_is_opaque"
_FAINT = "test_faint_gaussians_lose_their_gradient_where_they_can_be_counted"
_SQUARES = "test_ssim_sees_no_nan_of_a_poisoned_scene"
_RADII = "test_poisoned_gaussians_show_in_their_radii_though_not_in_the_image"
_ANY = "test_properties.py::test_any_numbers_give_sane_images_and_gradients"
_EDGE = "test_properties.py::test_footprints_at_the_frustum_edge_are_bounded"
_POINTS = "test_principal_point_off_centre_and_outside"
_CEILING = "test_colours_have_no_ceiling"
_NOWHERE = "test_nothing_in_view"
_PIXELS = "test_one_gaussian_over_millions_of_pixels_takes_memory_by_the_pixel"
_CROWD = "test_ten_thousand_gaussians_in_one_pixel"
_SANE = "test_properties.py::test_generated_scenes_give_sane_images_and_gradients"
_HALVES = "test_properties.py::test_two_halves_make_the_image"
_BATCH = "test_properties.py::test_a_camera_of_a_batch_sees_what_it_sees_alone"
_CENTRE = "F mx = P.fx * xn + P.cx, my = P.fy * yn + P.cy;"
_OFF_CENTRE = "F mx = P.fx * xn + 0.5f * P.width, my = P.fy * yn + 0.5f * P.height;"
_INSIDE = "T[i] = LANE < (F)(i < rows ? (float)columns : 0.f) ? (F)1.f : (F)0.f;"
_KEPT = 'workspace.need("hit_grad", block.hits * block.grad_stride)'
_FINITE_COLOUR = "good &= (__builtin_bit_cast(int, value) & 0x7f800000) != 0x7f800000;"
_CLAMP = "F u = vmin(vmax(xn, (F)P.x_low), (F)P.x_high), v = vmin(vmax(yn, (F)P.y_low), (F)P.y_high);"

REMEDIES = [
    Remedy(
        "non-finite positions and rotations are culled",
        CPU,
        "I ok = finite(X) & finite(Y) & finite(Z) & finite(qw) & finite(qx) & finite(qy) & finite(qz);",
        "I ok = LANE >= (F)0.f;",
        _NON_FINITE,
        "cpu",
        (
            (" & (xx + yy < @VARIANCE_MAX@f)", " & ~(xx + yy >= @VARIANCE_MAX@f)"),
            ("ok &= (mx + hx >= 0.5f) & (mx - hx <= (float)P.width - 0.5f);", ""),
            ("ok &= (my + hy >= 0.5f) & (my - hy <= (float)P.height - 0.5f);", ""),
        ),
    ),
    Remedy(
        "NaN log-scales are culled",
        CPU,
        "ok &= (r0 <= (F)@LOG_SCALE_MAX@f) & (r1 <= (F)@LOG_SCALE_MAX@f) & (r2 <= (F)@LOG_SCALE_MAX@f);",
        "",
        _NON_FINITE,
        "cpu",
    ),
    Remedy("non-finite colours are culled", CPU, _FINITE_COLOUR, "", _NON_FINITE, "cpu"),
    Remedy("non-finite colours never reach SSIM", CPU, _FINITE_COLOUR, "", _SQUARES, "cpu"),
    Remedy(
        "non-finite harmonics are culled",
        CPU,
        "ok &= finite(value);",
        "",
        "test_non_finite_harmonics_are_culled",
        "cpu",
    ),
    Remedy(
        "what has no colour has no radius",
        CPU,
        "else { P.radii[i] = 0; P.means2d[2 * i] = 0; P.means2d[2 * i + 1] = 0; }",
        "",
        _RADII,
        "cpu",
    ),
    Remedy("non-finite colours are culled, any numbers", CPU, _FINITE_COLOUR, "", _ANY, "cpu"),
    Remedy("largest variance", CPU, " & (xx + yy < @VARIANCE_MAX@f)", "", _ENORMOUS, "cpu"),
    Remedy("largest variance, e^20", CPU, " & (xx + yy < @VARIANCE_MAX@f)", "", "test_extreme_scales", "cpu"),
    Remedy(
        "spans that were not kept are worked out again",
        CPU,
        "P.span_start[slot] = fits ? (int)kept : -1;",
        "P.span_start[slot] = (int)kept;",
        "test_a_tall_image_needs_more_tile_spans_than_are_kept",
        "cpu",
    ),
    Remedy("near plane", CPU, "(deep > (F)P.near) & ", "", "test_near_plane", "cpu"),
    Remedy(
        "near plane, exactly",
        CPU,
        "(deep > (F)P.near)",
        "(deep >= (F)P.near)",
        "test_gaussian_on_the_near_plane_is_culled",
        "cpu",
    ),
    Remedy(
        "near plane in units of the scene",
        CPU,
        "(deep > (F)P.near)",
        "(deep > (F)0.01f)",
        "test_scale_of_the_world_does_not_matter",
        "cpu",
    ),
    Remedy("Jacobian's clamp", CPU, _CLAMP, "F u = xn, v = yn;", _FOOTPRINT, "cpu"),
    Remedy("Jacobian's clamp, any Gaussian", CPU, _CLAMP, "F u = xn, v = yn;", _EDGE, "cpu"),
    Remedy(
        "Jacobian's clamp, images",
        CPU,
        _CLAMP,
        "F u = xn, v = yn;",
        "test_frustum_edge_jacobian_is_clamped_about_the_principal_point",
        "cpu",
    ),
    Remedy(
        "no gradient through the Jacobian's clamp",
        CPU,
        "F gu = ((xn >= P.x_low) & (xn <= P.x_high)) ? -ja * gjc : (F)0.f;",
        "F gu = -ja * gjc;",
        "test_no_gradient_passes_the_frustum_clamp",
        "cpu",
    ),
    Remedy(
        "the clamp is about the principal point",
        "raster/settings.py",
        "return -cx / fx - mx, (width - cx) / fx + mx,",
        "return -width / 2 / fx - mx, width / 2 / fx + mx,",
        "test_a_crop_with_the_principal_point_aside_is_the_crop_of_the_image",
        "cpu",
    ),
    Remedy("low-pass", CPU, "LOW_PASS = @LOW_PASS@f;", "LOW_PASS = 0.f;", _POINT, "cpu"),
    Remedy(
        "low-pass, singular covariances",
        CPU,
        "LOW_PASS = @LOW_PASS@f;",
        "LOW_PASS = 0.f;",
        "test_degenerate_covariances",
        "cpu",
    ),
    Remedy(
        "determinant without cancellation",
        CPU,
        "F dr = n0 * n0 + n1 * n1 + n2 * n2, det = dr + LOW_PASS * (rxx + ryy) + LOW_PASS * LOW_PASS;",
        "F dr = rxx * ryy - xy * xy, det = xx * yy - xy * xy;",
        "test_long_thin_gaussians_keep_their_precision",
        "cpu",
    ),
    Remedy(
        "floor of the opacity compensation",
        CPU,
        "log2v(vmax(dr / det, (F)@COMPENSATION2_MIN@f))",
        "log2v(dr / det)",
        _FLOOR,
        "cpu",
    ),
    Remedy(
        "no gradient below that floor",
        CPU,
        "I free = dr > @COMPENSATION2_MIN@f * det;",
        "I free = dr >= 0.f * det;",
        _FLOOR,
        "cpu",
    ),
    Remedy(
        "zero quaternions are culled", CPU, "(qmax > (F)@QUAT_MIN@f) & ", "", "test_zero_quaternion_is_culled", "cpu"
    ),
    Remedy(
        "quaternions are divided by their largest component first",
        CPU,
        "iq = 1.f / qmax;",
        "iq = (F)1.f;",
        _LENGTH,
        "cpu",
    ),
    Remedy("alpha's clamp", CPU, "al = vmin(raw, (F)ALPHA_MAX);", "al = raw;", "test_opacity_at_its_ends", "cpu"),
    Remedy(
        "no gradient through alpha's clamp",
        CPU,
        "v = raw <= ALPHA_MAX ? v : (F)0.f;",
        "",
        "test_no_gradient_passes_the_alpha_clamp",
        "cpu",
    ),
    Remedy("a pixel stops", CPU, "(before > T_STOP)", "(before > 0.f)", _STOP, "cpu"),
    Remedy("alpha's cut", CPU, "(p >= PMIN) & ", "", _FAINT, "cpu"),
    Remedy(
        "extent by opacity",
        CPU,
        "F level = vmax(lop - PMIN, (F)0.f) * (2.f * LN2);",
        "F level = (F)9.f;",
        "test_opaque_gaussians_reach_beyond_three_sigma",
        "cpu",
    ),
    Remedy("black harmonics may brighten", CPU, " | (gc[c] < 0.f)", "", _BLACK, "cpu"),
    Remedy(
        "black harmonics do not darken", CPU, "((value > 0.f) | (gc[c] < 0.f)) ? gc[c] : (F)0.f", "gc[c]", _BLACK, "cpu"
    ),
    Remedy(
        "ties go by index",
        CPU,
        "for (long long i = 0; i < n; i++) {\n        int place",
        "for (long long i = n - 1; i >= 0; i--) {\n        int place",
        "test_equal_depths_keep_the_order_of_the_inputs",
        "cpu",
    ),
    Remedy(
        "hits are counted in 64 bits",
        CPU,
        "long long total = 0, n = 0;",
        "int total = 0; long long n = 0;",
        "test_more_hits_than_an_index_holds_are_refused_before_memory_is_taken",
        "cpu",
    ),
    Remedy(
        "too many hits are refused",
        "raster/cpu.py",
        "if block.hits > _HITS_MAX:",
        "if False:",
        "test_more_hits_than_an_index_holds_are_refused_before_memory_is_taken",
        "cpu",
    ),
    Remedy(
        "weights add up tile by tile, not pixel by pixel",
        CPU,
        "total += h[2 * j];",
        "for (int q = 0; q < 256; q++) total += h[2 * j] / 256.f;",
        "test_one_gaussian_over_millions_of_pixels_takes_memory_by_the_pixel",
        "cpu",
    ),
    Remedy(
        "gradients are kept by the tile, not by the pixel",
        CPU_HOST,
        _KEPT,
        'workspace.need("hit_grad", 512 * block.hits * block.grad_stride); workspace.buffers["hit_grad"].zero_()',
        _PIXELS,
        "cpu",
    ),
    Remedy(
        "gradients are kept by the hit, not by its pixels",
        CPU_HOST,
        _KEPT,
        'workspace.need("hit_grad", 256 * block.hits * block.grad_stride); workspace.buffers["hit_grad"].zero_()',
        _CROWD + "_take_memory_by_the_gaussian",
        "cpu",
    ),
    Remedy(
        "a tile has as many hits as there are",
        CPU,
        "start = P.tile_start[tile], stop = P.tile_start[tile + 1];",
        "start = P.tile_start[tile], all = P.tile_start[tile + 1], stop = all < start + 512 ? all : start + 512;",
        _CROWD,
        "cpu",
    ),
    Remedy(
        "no largest size on screen",
        CPU,
        "F hx = vsqrt(level * xx), hy = vsqrt(level * yy);",
        "F hx = vmin(vsqrt(level * xx), (F)64.f), hy = vmin(vsqrt(level * yy), (F)64.f);",
        "test_one_gaussian_over_all_pixels",
        "cpu",
    ),
    Remedy("the principal point", CPU, _CENTRE, _OFF_CENTRE, _POINTS, "cpu"),
    Remedy(
        "the clamp is about the principal point, wherever it is",
        CPU_HOST,
        "limits = camera_limits(K, scene.width, scene.height, FRUSTUM_MARGIN)",
        "u, v = 0.65 * scene.width / block.fx, 0.65 * scene.height / block.fy; limits = -u, u, -v, v",
        _POINTS,
        "cpu",
    ),
    Remedy(
        "no ceiling on colours",
        CPU,
        "                r[c] = value;",
        "                r[c] = smin(value, 1.f);",
        _CEILING,
        "cpu",
    ),
    Remedy("no ceiling on harmonics", CPU, "vmax(value, (F)0.f)", "vmin(vmax(value, (F)0.f), (F)1.f)", _CEILING, "cpu"),
    Remedy("what is behind the camera is culled", CPU, "(deep > (F)P.near) & ", "", _NOWHERE, "cpu"),
    Remedy(
        "the background shows where nothing is",
        CPU,
        "fma(T[i], (F)P.background[c], C[c][i])",
        "C[c][i]",
        _NOWHERE,
        "cpu",
    ),
    Remedy(
        "near plane in units of the scene, any scale",
        CPU,
        "(deep > (F)P.near)",
        "(deep > (F)0.01f)",
        "test_properties.py::test_scaling_the_world_scales_the_depth",
        "cpu",
    ),
    Remedy("alpha's clamp, generated scenes", CPU, "al = vmin(raw, (F)ALPHA_MAX);", "al = raw;", _SANE, "cpu"),
    Remedy("pixels beyond the image take no weight, generated scenes", CPU, _INSIDE, "T[i] = (F)1.f;", _SANE, "cpu"),
    Remedy("pixels beyond the image take no weight, halves", CPU, _INSIDE, "T[i] = (F)1.f;", _HALVES, "cpu"),
    Remedy("the principal point, halves", CPU, _CENTRE, _OFF_CENTRE, _HALVES, "cpu"),
    Remedy(
        "depth decides the order, not the index",
        CPU,
        "P.order[n] = (int)s; P.key[n] = __builtin_bit_cast(int, P.aux[s * 4 + 3]); n++;",
        "P.order[n] = (int)s; P.key[n] = 0; n++;",
        "test_properties.py::test_order_of_the_gaussians_changes_nothing",
        "cpu",
    ),
    Remedy(
        "every digit of the depth is sorted by",
        CPU,
        "for (int shift = 0; shift < 33; shift += 11) {",
        "for (int shift = 22; shift < 33; shift += 11) {",
        "test_properties.py::test_order_of_the_gaussians_changes_nothing",
        "cpu",
    ),
    Remedy(
        "footprints turn with the camera",
        CPU,
        "T0[i] = ja * V[i] + jc * V[8 + i]; T1[i] = jb * V[4 + i] + jd * V[8 + i];",
        "float z = i == 2; T0[i] = ja * (float)(i == 0) + jc * z; T1[i] = jb * (float)(i == 1) + jd * z;",
        "test_properties.py::test_moving_the_world_and_the_camera_together_changes_nothing",
        "cpu",
    ),
    Remedy(
        "a camera of its own for every image",
        CPU_HOST,
        "_set_up(lease.workspace, scene, c, channels)",
        "_set_up(lease.workspace, scene, 0, channels)",
        _BATCH,
        "cpu",
    ),
    Remedy("intrinsics of its own for every image", CPU_HOST, "K = scene.Ks[camera]", "K = scene.Ks[0]", _BATCH, "cpu"),
    Remedy(
        "a workspace of its own for every image, until its gradients are taken",
        CPU_HOST,
        "leases = [_Lease() for _ in range(cameras)]",
        "leases = [_Lease()] * cameras",
        _BATCH,
        "cpu",
    ),
    Remedy(
        "harmonics are seen from where the camera is",
        CPU,
        "F X = load(gather[0]) - cam[0], Yd",
        "F X = load(gather[0]), Yd",
        "test_properties.py::test_bodies_agree_with_the_oracle_on_any_scene",
        "cpu",
    ),
    Remedy(
        "gradient of the opacity compensation",
        CPU,
        "g2c -= h * ic; g2y -= h * iy;",
        "",
        "test_properties.py::test_gradients_agree_with_the_oracle_on_good_scenes",
        "cpu",
    ),
    Remedy(
        "largest image",
        API,
        "if not 1 <= width <= SIDE_MAX or not 1 <= height <= SIDE_MAX:",
        "if width < 1 or height < 1:",
        "test_images_wider_than_a_tile_column_can_say_are_refused",
        "cpu",
    ),
    Remedy(
        "tests are phrased so that NaN fails",
        API,
        "if not scene.settings.near > 0:",
        "if scene.settings.near <= 0:",
        "test_wrong_arguments_are_named",
        "cpu",
    ),
    Remedy(
        "no SSIM on images below its window",
        "train/losses.py",
        " and min(image.shape[:2]) >= _WINDOW",
        "",
        "test_images_smaller_than_the_window_of_ssim_are_compared_by_l1_alone",
        "",
    ),
    Remedy(
        "SSIM refuses images below its window",
        "raster/ssim.py",
        " or min(image.shape[:2]) < WINDOW",
        "",
        "test_ssim.py::test_refuses_what_it_cannot_do",
        "",
    ),
    Remedy(
        "SSIM's range is 1",
        "raster/kernels/ssim.cpp",
        "C1 = 1e-4f",
        "C1 = 6.5025f",
        "test_ssim_takes_one_as_the_range_of_the_data",
        "float32",
    ),
    Remedy(
        "SSIM's range is 1, in torch",
        "train/losses.py",
        "_C1, _C2 = 0.01**2, 0.03**2",
        "_C1, _C2 = 2.55**2, 7.65**2",
        "test_ssim_takes_one_as_the_range_of_the_data",
        "float64",
    ),
    Remedy(
        "non-finite colours are culled",
        REFERENCE,
        "ok &= scene.colors.isfinite().all(-1)",
        "pass",
        _NON_FINITE,
        "reference",
    ),
    Remedy(
        "non-finite harmonics are culled",
        REFERENCE,
        "ok &= scene.sh[:, : (scene.sh_degree + 1) ** 2].isfinite().all(-1).all(-1)",
        "pass",
        "test_non_finite_harmonics_are_culled",
        "reference",
    ),
    Remedy(
        "zero quaternions are culled",
        REFERENCE,
        " & (scene.quats.abs().amax(-1) > k.QUAT_MIN)",
        "",
        "test_zero_quaternion_is_culled",
        "reference",
    ),
    Remedy(
        "quaternions are divided by their largest component first",
        REFERENCE,
        "quats = quats / quats.detach().abs().amax(-1, keepdim=True)",
        "pass",
        _LENGTH,
        "reference32",
    ),
    Remedy("near plane", REFERENCE, "(z > scene.settings.near) & ", "", "test_near_plane", "reference"),
    Remedy(
        "near plane, exactly",
        REFERENCE,
        "(z > scene.settings.near)",
        "(z >= scene.settings.near)",
        "test_gaussian_on_the_near_plane_is_culled",
        "reference",
    ),
    Remedy(
        "Jacobian's clamp",
        REFERENCE,
        "u, v, zero = (x / z).clamp(x_low, x_high), (y / z).clamp(y_low, y_high)",
        "u, v, zero = x / z, y / z",
        _FOOTPRINT,
        "reference",
    ),
    Remedy(
        "Jacobian's clamp, any Gaussian",
        REFERENCE,
        "u, v, zero = (x / z).clamp(x_low, x_high), (y / z).clamp(y_low, y_high)",
        "u, v, zero = x / z, y / z",
        _EDGE,
        "reference",
    ),
    Remedy("largest variance", REFERENCE, " & (f.xx + f.yy < k.VARIANCE_MAX)", "", _ENORMOUS, "reference"),
    Remedy(
        "what overflowed and was culled takes no part in the gradients",
        REFERENCE,
        "    index = candidates[order]\n    f = _footprint(scene, camera, index)\n",
        "    index = candidates[order]\n    f = _footprint(scene, camera, candidates)\n"
        "    f = _Footprint(*(value[order] for value in vars(f).values()))\n",
        "test_what_overflows_and_is_culled_gets_zero_gradients",
        "reference32",
    ),
    Remedy("low-pass", "raster/constants.py", "LOW_PASS = 0.3", "LOW_PASS = 1e-9", _POINT, "reference"),
    Remedy(
        "determinant without cancellation",
        REFERENCE,
        "cross(B[:, 0], B[:, 1]).square().sum(-1)",
        "raw[:, 0, 0] * raw[:, 1, 1] - raw[:, 0, 1].square()",
        "test_long_thin_gaussians_keep_their_precision",
        "reference32",
    ),
    Remedy(
        "floor of the opacity compensation",
        REFERENCE,
        ".clamp_min(k.COMPENSATION2_MIN).sqrt()",
        ".sqrt()",
        _FLOOR,
        "reference",
    ),
    Remedy(
        "alpha's clamp",
        REFERENCE,
        "alpha.clamp_max(k.ALPHA_MAX).masked_fill",
        "alpha.masked_fill",
        "test_opacity_at_its_ends",
        "reference",
    ),
    Remedy("alpha's cut", REFERENCE, ".masked_fill(alpha < k.ALPHA_MIN, 0.0)", "", _FAINT, "reference"),
    Remedy("a pixel stops", REFERENCE, ".masked_fill(before <= k.T_STOP, 0.0)", "", _STOP, "reference"),
    Remedy(
        "extent by opacity",
        REFERENCE,
        "level = 2 * torch.log(f.opacity / k.ALPHA_MIN)",
        "level = torch.full_like(f.opacity, 9.0)",
        "test_opaque_gaussians_reach_beyond_three_sigma",
        "reference",
    ),
    Remedy("black harmonics may brighten", REFERENCE, "(x > 0) | (grad < 0)", "x > 0", _BLACK, "reference"),
    Remedy(
        "ties go by index",
        REFERENCE,
        "torch.sort(f.depth[order], stable=True).indices",
        "(len(order) - 1) - torch.sort(f.depth[order].flip(0), stable=True).indices",
        "test_equal_depths_keep_the_order_of_the_inputs",
        "reference",
    ),
    Remedy(
        "inputs that reach no pixel get zero gradients, not none",
        REFERENCE,
        "colors = colors + value.reshape(-1)[:0].sum()",
        "pass",
        "test_no_cameras",
        "reference",
    ),
    Remedy(
        "the same where nothing is in view",
        REFERENCE,
        "colors = colors + value.reshape(-1)[:0].sum()",
        "pass",
        "test_no_gaussians",
        "reference",
    ),
    Remedy(
        "a gradient passes the Jacobian's clamp where it does not clamp",
        REFERENCE,
        "u, v, zero = (x / z).clamp(",
        "u, v, zero = (x / z).detach().clamp(",
        "test_reference.py::test_gradients_are_those_of_finite_differences",
        "reference",
    ),
    Remedy(
        "no ceiling on colours",
        REFERENCE,
        "parts.append(scene.colors[index])",
        "parts.append(scene.colors[index].clamp_max(1))",
        _CEILING,
        "reference",
    ),
    Remedy(
        "memory is bounded by blending in steps",
        REFERENCE,
        "_LANES = 2**20",
        "_LANES = 2**40",
        "test_ten_thousand_gaussians_in_one_pixel_take_memory_by_the_gaussian",
        "reference",
    ),
    Remedy(
        "non-finite colours are culled",
        CUDA,
        "ok = ok && finite(value); channel[c] = value;",
        "channel[c] = value;",
        _NON_FINITE,
        "cuda",
    ),
    Remedy(
        "non-finite harmonics are culled",
        CUDA,
        "if (!(finite(c0) && finite(c1) && finite(c2))) return;",
        "",
        "test_non_finite_harmonics_are_culled",
        "cuda",
    ),
    Remedy("near plane", CUDA, "pz > P.near && ", "", "test_near_plane", "cuda"),
    Remedy(
        "Jacobian's clamp",
        CUDA,
        "float u = smin(smax(xn, x_low), x_high), v = smin(smax(yn, y_low), y_high);",
        "float u = xn, v = yn;",
        _FOOTPRINT,
        "cuda",
    ),
    Remedy(
        "no gradient through the Jacobian's clamp",
        CUDA,
        "float gu = xn >= x_low && xn <= x_high ? -ja * gjc : 0.f,",
        "float gu = -ja * gjc,",
        "test_no_gradient_passes_the_frustum_clamp",
        "cuda",
    ),
    Remedy("largest variance", CUDA, " && xx + yy < @VARIANCE_MAX@f", "", _ENORMOUS, "cuda"),
    Remedy("low-pass", CUDA, "LOW_PASS = @LOW_PASS@f;", "LOW_PASS = 0.f;", _POINT, "cuda"),
    Remedy(
        "determinant without cancellation",
        CUDA,
        "float dr = n0 * n0 + n1 * n1 + n2 * n2, det = dr + LOW_PASS * (rxx + ryy) + LOW_PASS * LOW_PASS;",
        "float dr = rxx * ryy - xy * xy, det = xx * yy - xy * xy;",
        "test_long_thin_gaussians_keep_their_precision",
        "cuda",
    ),
    Remedy(
        "floor of the opacity compensation",
        CUDA,
        "log2f(smax(dr / det, @COMPENSATION2_MIN@f))",
        "log2f(dr / det)",
        _FLOOR,
        "cuda",
    ),
    Remedy("zero quaternions are culled", CUDA, "qmax > @QUAT_MIN@f && ", "", "test_zero_quaternion_is_culled", "cuda"),
    Remedy(
        "quaternions are divided by their largest component first",
        CUDA,
        "float iq = 1.f / qmax,",
        "float iq = 1.f,",
        _LENGTH,
        "cuda",
    ),
    Remedy("alpha's clamp", CUDA, "al = smin(raw, ALPHA_MAX)", "al = raw", "test_opacity_at_its_ends", "cuda"),
    Remedy(
        "no gradient through alpha's clamp",
        CUDA,
        "raw <= ALPHA_MAX ? seen - QUOTIENT(al, 1.f - al) * behind : 0.f",
        "seen - QUOTIENT(al, 1.f - al) * behind",
        "test_no_gradient_passes_the_alpha_clamp",
        "cuda",
    ),
    Remedy(
        "alpha's cut",
        CUDA,
        "if (!(p >= PMIN && T[s] > T_STOP)) continue;",
        "if (!(T[s] > T_STOP)) continue;",
        _FAINT,
        "cuda",
    ),
    Remedy(
        "a pixel stops",
        CUDA,
        "if (!(p >= PMIN && T[s] > T_STOP)) continue;",
        "if (!(p >= PMIN)) continue;",
        _STOP,
        "cuda",
    ),
    Remedy("black harmonics may brighten", CUDA, " || gc[0] < 0.f", "", _BLACK, "cuda"),
]


def without_remedy() -> list[str]:
    """Tests, file::function, that stand for a known failure or are a property of every input, but have no remedy."""
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    from benchmarks.numerics import ROWS, test_names

    named = {test for _, tests, _ in ROWS for test in tests}
    named |= {test for test in test_names() if test.startswith("test_properties.py::test_")}
    return sorted(named - {remedy.full_test for remedy in REMEDIES})


def _either(bodies: set[str]) -> str:
    """pytest's -k for tests of any of the bodies, and those of none."""
    unwanted = {"cpu", "reference", "cuda", "gpu"} - {body.removesuffix("32") for body in bodies}
    return " and ".join(f"not {body}" for body in sorted(unwanted))


def _run(folder: Path, arguments: list[str]) -> subprocess.CompletedProcess[str]:
    environment = {
        **os.environ,
        "WARP_CACHE_PATH": str(folder / "kernels"),
        "PYTHONPATH": str(folder),
        "SPLANNEQUIN_NO_SHRINK": "1",
    }
    command = [sys.executable, "-P", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--tb=line", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=900)


def _try(folder: Path, remedy: Remedy) -> str:
    """Take one remedy out, run its test, put it back. What happened, in a word; 'noticed' is what should."""
    texts = remedy.texts(folder / "torch_backend")
    changed = dict(texts)
    for old, new in remedy.changes:
        if not any(old in text for text in changed.values()):
            return "TEXT NOT FOUND"
        changed = {path: text.replace(old, new) for path, text in changed.items()}
    try:
        for path, text in changed.items():
            path.write_text(text, encoding="utf-8")
        code = _run(folder, remedy.command).returncode
    finally:
        for path, text in texts.items():
            path.write_text(text, encoding="utf-8")
    # 1: tests failed; below 0: the process died, as an out-of-bounds access makes it.
    return "noticed" if code == 1 or code < 0 else f"NOT NOTICED (pytest's exit code {code})"


def main(words: list[str]) -> int:
    chosen = [r for r in REMEDIES if not words or any(w in f"{r.name} {r.file} {r.test} {r.body}" for w in words)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for item in COPIED:
            source = ROOT / item
            if source.is_dir():
                shutil.copytree(source, folder / item, ignore=shutil.ignore_patterns("__pycache__"))
            elif source.exists():
                shutil.copy2(source, folder / item)
        run = _run(folder, [*dict.fromkeys(r.node for r in chosen), "-k", _either({r.body for r in chosen})])
        if run.returncode:
            print(f"fails before anything is taken out:\n{run.stdout[-3000:]}{run.stderr[-1000:]}")
            return 1
        bad = 0
        for remedy in chosen:
            start = time.monotonic()
            verdict = _try(folder, remedy)
            bad += verdict != "noticed"
            print(
                f"{verdict:12s} {time.monotonic() - start:5.0f} s  {remedy.file}: {remedy.name}  [{remedy.test}, "
                f"{remedy.body or 'no body'}]",
                flush=True,
            )
    print(f"{len(chosen) - bad} of {len(chosen)} remedies: their test fails without them")
    missing = without_remedy()
    print(f"tests of known failures and properties that have no remedy: {', '.join(missing) or 'none'}")
    return int(bad > 0 or bool(missing))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
