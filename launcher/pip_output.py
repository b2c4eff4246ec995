"""Translates pip's output into an artist's words."""

from __future__ import annotations

import platform
import re
import sysconfig
import urllib.parse
from pathlib import Path

from torch_backend.contract import ExitCode

from .errors import LauncherError


def condense_pip(line: str) -> str | None:
    """A line of pip's output in short, such as `torch 2.13.0 (190.2 MB)`; None for a line that is not shown."""
    wheel = re.match(
        r"(?:Downloading|Using cached|Processing) (?:\S*[/\\])?([^\s/\\]+)\.whl(?!\S)(?: (\(\d[^)]*\)))?", line
    )
    if wheel:
        name, version = wheel.group(1).split("-")[:2]
        return f"{name} {version.replace('%2B', '+')} {wheel.group(2) or ''}".rstrip()
    found = re.match(r"Installing collected packages: (.*)", line)
    if found:
        return f"installing {len(found.group(1).split(','))} packages"
    return "installed" if line.startswith("Successfully installed") else None


BROKEN_CONNECTION = re.compile(
    r"connection broken by|ConnectionError|Max retries exceeded|Temporary failure|Name or service|getaddrinfo|"
    r"timed out|Network is unreachable|ProxyError|SSLError|IncompleteRead|RemoteDisconnected"
)
"""pip's messages about an unreachable index. pip's last message would only say that no version was found."""


SYSTEMS = (
    "it needs a 64-bit Python on Windows or Linux with an Intel or AMD processor (x86-64), or on a Mac with Apple "
    "silicon"
)
"""Systems for which all packages have wheels."""
_UNSUPPORTED = (
    (r"win32", "a 32-bit Python on Windows"),
    (r"win-arm", "Windows on ARM"),
    (r"macosx-.*-x86_64", "a Mac with an Intel processor"),
    (r"linux-(aarch64|arm)", "Linux on ARM"),
)
"""Other systems, by the beginning of `sysconfig.get_platform()`."""


def lacking_system(system: str | None = None) -> str:
    """Name of a system for which some package has no wheel; empty for supported systems.

    Args:
        system: `sysconfig.get_platform()` of a Python; None: of the running one.
    """
    system = (system or sysconfig.get_platform()).replace("universal2", platform.machine())
    if re.fullmatch(r"win-amd64|linux-x86_64|macosx-.*-arm64", system):
        return ""
    return next((words for pattern, words in _UNSUPPORTED if re.match(pattern, system)), system)


def refuse(name: str, log: Path, step: str, output: str, wheels: Path | None = None, system: str | None = None) -> None:
    """Raises LauncherError for a failed step of a set-up, with a sentence derived from the step's output.

    Args:
        name: name of the environment.
        log: file with the whole output of the set-up.
        step: the failed step.
        output: output of the step.
        wheels: the folder from which packages are installed instead of an index.
        system: as in `lacking_system`.
    """
    lines = [line.strip() for line in output.splitlines() if line.strip()] or ["no output"]
    telling = [line for line in lines if re.search(r"error|not found|cannot|No space", line, re.I)]
    last = re.sub(r"^(ERROR: |\w*Error: )", "", (telling or lines)[-1]).rstrip(".")
    code = ExitCode.ENVIRONMENT
    answered = re.search(r"from versions: (?!none)", output)
    if re.search(r"No space left|Errno 28|not enough space", output, re.I):
        code, advice = ExitCode.DISK, "free some disk, or set SPLANNEQUIN_HOME to a folder on another disk"
    elif "DO NOT MATCH THE HASHES" in output:
        last, advice = _hash_mismatch(output, wheels)
    elif wheels is not None and re.search(r"No matching distribution|from versions:", output):
        lacking = re.search(r"No matching distribution found for ([\w.=+-]+)", output)
        last = f"{wheels} has no wheel of {lacking.group(1) if lacking else 'a package'} for this Python and system"
        advice = "put it there (see docs/manual/setup.md, Without a network), then run the same command again"
    elif BROKEN_CONNECTION.search(output) and not answered:
        last, advice = _unreachable(output)
    elif re.search(r"ensurepip|python3-venv", output):
        advice = "install the venv module of this Python (Debian and Ubuntu: apt install python3-venv)"
    elif re.search(r"No matching distribution|from versions:", output) and lacking_system(system):
        lacking = re.search(r"No matching distribution found for ([\w.-]+)", output)
        last = f"there is no {lacking.group(1) if lacking else 'package'} for {lacking_system(system)}"
        advice = SYSTEMS
    elif re.search(r"No matching distribution|from versions:", output):
        advice = "use Python 3.11 or 3.13 on 64-bit Windows, macOS or Linux, or check which package index pip uses"
    elif re.search(r"lib\S+\.so\S*: cannot open shared object", output):
        advice = "install that library with the system's package manager"
    else:
        advice = "read the log, and run the same command again: it continues where it stopped"
    raise LauncherError(f"Setting up {name} failed at {step} ({last[:200]}): {advice}. Log: {log}", code)


def _hash_mismatch(output: str, wheels: Path | None) -> tuple[str, str]:
    """(problem, advice) for a file whose SHA-256 is not in the lock, from pip's output."""
    named = re.search(r"^([\w.-]+)\S* from (\S+)", output.partition("DO NOT MATCH THE HASHES")[2], re.M)
    package = named.group(1) if named else "a package"
    where = wheels or (named and urllib.parse.urlsplit(named.group(2)).hostname) or "the package index"
    last = f"the file of {package} in {where} is not the one that this version was tested with: its SHA-256 differs"
    advice = "nothing of it was installed; take that file from PyPI" if wheels else "nothing of it was installed"
    return last, f"{advice}. If this is a company's index, ask its administrator"


def _unreachable(output: str) -> tuple[str, str]:
    """(problem, advice) for an unreachable server, from pip's output."""
    named = re.search(r"host='([^']+)'", output)
    listed = re.search(r"Looking in indexes: (.*)", output)
    urls = [url.strip() for url in listed.group(1).split(",")] if listed else ["https://pypi.org/simple"]
    hosts = [part.hostname for part in map(urllib.parse.urlsplit, urls) if part.scheme != "file" and part.hostname]
    what = named.group(1) if named else " or ".join(dict.fromkeys(hosts)) or "the package index"
    retry = "then run the same command again: it continues where it stopped"
    if re.search(r"ProxyError|Cannot connect to proxy", output):
        return f"the proxy for {what} cannot be used", f"check HTTPS_PROXY and pip.conf, {retry}"
    if "SSLError" in output or "certificate" in output:
        advice = "if a proxy signs for it, set PIP_CERT to the proxy's certificate"
        return f"the certificate of {what} is not accepted", f"{advice}, {retry}"
    advice = "check the network; behind a firewall, set a proxy (HTTPS_PROXY) or your own index (PIP_INDEX_URL)"
    return f"{what} cannot be reached", f"{advice}, {retry}"
