"""Output of pip: one line per package while it works, one sentence if it fails."""

import pytest

from launcher import pip_output
from launcher.environments import Environment
from launcher.errors import LauncherError

RETRYING = "WARNING: Retrying (Retry(total=0, connect=None)) after connection broken by "


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("Downloading warp_lang-1.19.0-py3-none-manylinux_2_34_x86_64.whl (149.3 MB)", "warp_lang 1.19.0 (149.3 MB)"),
        ("  Using cached https://x.org/a/av-18.1.0-cp311-abi3.whl (38.4 MB)".strip(), "av 18.1.0 (38.4 MB)"),
        ("Processing /wheels/torch-2.13.0%2Bcpu-cp311-cp311-linux_x86_64.whl (from -r b.txt)", "torch 2.13.0+cpu"),
        ("Downloading numpy-2.4.6-cp311-cp311-win_amd64.whl.metadata (62 kB)", None),
        ("Installing collected packages: mpmath, zstandard, torch", "installing 3 packages"),
        ("Requirement already satisfied: numpy in ./x", None),
    ],
)
def test_pip_in_one_line_per_package(line: str, shown: str | None):
    assert pip_output.condense_pip(line) == shown


@pytest.mark.parametrize(
    ("printed", "says"),
    [
        (
            RETRYING + "'SSLError(SSLCertVerificationError(1, '[SSL: CERTIFICATE_VERIFY_FAILED]'))': /simple/torch/\n"
            "ERROR: No matching distribution found for torch==2.13.0",
            "the certificate of pypi.org is not accepted",
        ),
        (
            "ERROR: Could not install packages due to an OSError: HTTPSConnectionPool(host='files.pythonhosted.org', "
            "port=443): Max retries exceeded with url: /packages/x.whl",
            "files.pythonhosted.org cannot be reached",
        ),
        (  # the connection broke once, but the index answered
            RETRYING + "'ReadTimeoutError(...)': /simple/torch/\n"
            "ERROR: Could not find a version that satisfies torch==9 (from versions: 2.12.0, 2.13.0)\n"
            "ERROR: No matching distribution found for torch==9",
            "use Python 3.11",
        ),
        ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "free some disk"),
    ],
)
def test_what_pip_prints_in_a_sentence(bare_environment: Environment, printed: str, says: str):
    with pytest.raises(LauncherError) as refused:
        pip_output.refuse(
            bare_environment.name, bare_environment.log, "installing packages", printed, system="linux-x86_64"
        )
    assert says in str(refused.value)


@pytest.mark.parametrize(
    ("system", "words"),
    [
        ("win-arm64", "Windows on ARM"), ("win32", "32-bit Python"), ("macosx-14.0-x86_64", "a Mac with an Intel"),
        ("linux-aarch64", "Linux on ARM"), ("linux-riscv64", "linux-riscv64"),
    ],
)  # fmt: skip
def test_system_without_wheels_is_not_reported_as_wrong_python(bare_environment: Environment, system, words):
    printed = (
        "ERROR: Could not find a version that satisfies the requirement torch==2.13.0 (from versions: 2.2.0, 2.2.1)\n"
        "ERROR: No matching distribution found for torch==2.13.0"
    )
    with pytest.raises(LauncherError) as refused:
        pip_output.refuse(bare_environment.name, bare_environment.log, "installing packages", printed, system=system)
    said = str(refused.value)
    assert "there is no torch" in said and words in said and "use Python 3.11" not in said


@pytest.mark.parametrize("system", ["win-amd64", "linux-x86_64", "macosx-11.0-arm64"])
def test_systems_with_wheels_lack_none(system: str):
    assert pip_output.lacking_system(system) == ""
