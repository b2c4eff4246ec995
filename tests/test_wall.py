"""The wall between Blender and the backend, and calls that no file of the project may contain: read from the source."""

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from torch_backend.contract import shot_folder

ROOT = Path(__file__).resolve().parent.parent
BLENDER = {"bpy", "bpy_extras", "mathutils", "gpu", "gpu_extras", "bl_ext", "addon_utils", "blf", "bmesh"}
STATIONS = (
    "compiler_folders",
    "native",
    "small_tables",
    "footage",
    "cameras",
    "lens",
    "sfm",
    "motion",
    "footage.plates",
    "scene",
    "gaussians",
    "deformation",
    "raster",
    "supervision",
    "train",
    "motion_search",
    "freeze",
    "live",
)
"""Stations in the order of docs/architecture.md; a station imports only stations before it.

`footage/plates.py` and `motion_search.py` come late in this order.
"""
ROOMS = (
    "access",
    "properties",
    "compat",
    "compat_animation",
    "translations",
    "scene",
    "shot",
    "process",
    "ui",
    "footage",
    "solve",
    "train",
    "freeze",
    "bake",
    "settings",
    "command_line",
    "registration",
)
"""Rooms of the add-on in the order of docs/architecture.md; a room imports only rooms before it.

Only the registration imports the `step.py` of a step.
"""
LEVELS = 8
"""Longest allowed chain of imports between files of the add-on, counted in files."""
CODE_RUNNING_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib", "yaml"}
NETWORK_SERVERS = {"http.server", "socketserver", "xmlrpc.server", "wsgiref"}


def sources(folder: str) -> list[Path]:
    found = sorted((ROOT / folder).rglob("*.py"))
    assert found, f"{folder} holds no Python files"
    return found


def package_of(path: Path) -> list[str]:
    """Dotted parts of the package that the file's relative imports start from, seen from the repository root."""
    return list(path.relative_to(ROOT).parent.parts)


def dotted(node: ast.expr) -> str:
    """`a.b.c` of names and attributes; empty for any other expression."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def imports(tree: ast.AST, package: list[str]) -> Iterator[tuple[int, str]]:
    """(line, dotted name from the repository root) of everything a file imports, at any depth."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            start = [*base, *(node.module.split(".") if node.module else [])]
            yield from ((node.lineno, ".".join([*start, alias.name])) for alias in node.names)
        elif isinstance(node, ast.Call) and dotted(node.func) in ("importlib.import_module", "__import__"):
            yield from ((node.lineno, str(a.value)) for a in node.args[:1] if isinstance(a, ast.Constant))


class _RunTime(ast.NodeTransformer):
    def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
        self.generic_visit(node)
        return node.orelse if ast.unparse(node.test) == "TYPE_CHECKING" else node


def run_time(source: str) -> ast.AST:
    """Syntax tree of a file without imports that only the type checker needs, which do not affect the load order."""
    return _RunTime().visit(ast.parse(source))


@functools.cache
def imported_at_run_time(path: Path) -> list[str]:
    """Dotted names that a file imports at run time."""
    return [name for _, name in imports(run_time(path.read_text(encoding="utf-8")), package_of(path))]


def station_of(parts: Sequence[str]) -> str:
    """Station of a backend module, from the parts of its name below the backend."""
    whole = ".".join(parts[:2])
    return whole if whole in STATIONS else parts[0]


@functools.cache
def read(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


@functools.cache
def imported(path: Path) -> list[tuple[int, str]]:
    """`imports` of a file."""
    return list(imports(read(path), package_of(path)))


LAYOUT = {
    name_of_file
    for name, value in vars(shot_folder).items()
    if name.endswith(("_FILE", "_FILES", "_FOLDER", "_LOG", "_SUFFIX"))
    for name_of_file in (value if isinstance(value, tuple) else (value,))
}
"""Names in a shot folder, as spelled in the contract."""
FOREIGN_NAMES = {
    ("splannequin_addon/process/environment.py", "summary.json"),  # of the launcher, in an environment
    ("splannequin_addon/process/environment.py", ".splannequin"),
    ("torch_backend/cameras/imported.py", "colmap/sparse/0"),  # of another program
}
"""(file, name) for names that equal a name in the shot folder but mean something else."""


def layout_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, name) for each name of the shot folder that a file spells: file names anywhere, folder names in joined
    paths."""
    joined = {id(n.right) for n in ast.walk(tree) if isinstance(n, ast.BinOp) and isinstance(n.op, ast.Div)}
    docs = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            first, _, rest = node.value.partition("/")
            whole = node.value in LAYOUT and ("." in node.value or id(node) in joined)
            if whole or (first in LAYOUT and rest and " " not in rest):
                yield node.lineno, node.value


def not_for_the_addon(name: str) -> bool:
    parts = name.split(".")
    if parts[0] == "torch_backend":
        return parts[1:2] != ["contract"]
    return parts[0] not in {*BLENDER, *sys.stdlib_module_names, "numpy", "splannequin_addon"}


def not_for_the_contract(name: str) -> bool:
    parts = name.split(".")
    return parts[:2] != ["torch_backend", "contract"] and parts[0] not in sys.stdlib_module_names


def not_for_the_backend(name: str) -> bool:
    return name.split(".")[0] in {*BLENDER, "splannequin_addon", "splannequin"}


def dangers(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, what) of calls that execute file contents or serve the network; ruff finds eval, exec and shells."""
    for line, name in imports(tree, []):
        if name.split(".")[0] in CODE_RUNNING_MODULES or any(name.startswith(server) for server in NETWORK_SERVERS):
            yield line, f"import of {name}"
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        called = dotted(node.func)
        named = {k.arg: ast.unparse(k.value) for k in node.keywords if k.arg}
        if called == "torch.load" and named.get("weights_only") != "True":
            yield node.lineno, "torch.load() without weights_only=True"
        if called in ("np.load", "numpy.load") and named.get("allow_pickle", "False") != "False":
            yield node.lineno, "pickled arrays"


PYTHON = re.compile(r"(.*\.)?(python|executable)(\(\))?|str\(bpy\)")
"""Source of an expression for the path of a Python interpreter."""


def unsafe_children(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, command) of Python processes without -P (or -I), which import modules from their working folder."""
    shown = {
        id(argument)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and dotted(node.func) == "subprocess.list2cmdline"
        for argument in node.args
    }
    for node in ast.walk(tree):
        if not isinstance(node, (ast.List, ast.Tuple)) or len(node.elts) < 2 or id(node) in shown:
            continue
        words = [e.value for e in node.elts if isinstance(e, ast.Constant) and isinstance(e.value, str)]
        first = node.elts[0]
        python = words and not isinstance(first, ast.Constant) and PYTHON.fullmatch(ast.unparse(first))
        if python or {"-m", "-c"} & set(words):
            at = min((words.index(w) for w in ("-m", "-c") if w in words), default=len(words))
            if not {"-P", "-I"} & set(words[:at]):
                yield node.lineno, ast.unparse(node)


def unplaced_children(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, call) of child processes without an explicit working folder."""
    for node in ast.walk(tree):
        started = isinstance(node, ast.Call) and dotted(node.func) == "subprocess.Popen"
        if started and not {None, "cwd"} & {k.arg for k in node.keywords}:
            yield node.lineno, ast.unparse(node)


@pytest.mark.parametrize("folder", ["splannequin_addon", "torch_backend", "benchmarks", "launcher"])
def test_no_python_is_started_without_safe_path(folder: str):
    for path in sources(folder) if (ROOT / folder).is_dir() else [ROOT / folder]:
        wrong = list(unsafe_children(read(path)))
        if folder in ("splannequin_addon", "torch_backend"):
            wrong += unplaced_children(read(path))
        assert not wrong, path


@pytest.mark.parametrize(
    ("source", "unsafe"),
    [
        ("[python, '-m', 'torch_backend', 'run-job', folder]", True),
        ("run([sys.executable, '-m', 'pip', 'install'], cwd=shot)", True),
        ("command = [environment.python, '-c', probe]", True),
        ("[backend.python(), str(script), 'bake']", True),
        ("[*command, '-m', 'pytest']", True),
        ("[python, '-m', 'torch_backend', 'solve', '-P']", True),
        ("[python, '-P', '-m', 'torch_backend', 'run-job', folder]", False),
        ("[sys.executable, '-I', '-c', 'import sys']", False),
        ("subprocess.list2cmdline(['python', '-m', 'benchmarks.bench'])", False),
    ],
)
def test_the_scan_sees_an_unsafe_child(source: str, unsafe: bool):
    assert bool(list(unsafe_children(ast.parse(source)))) == unsafe


def asks_the_version(tree: ast.AST) -> bool:
    """True for a file whose behaviour depends on Blender's version."""
    return any(isinstance(n, ast.Attribute) and ast.unparse(n) == "bpy.app.version" for n in ast.walk(tree))


def test_only_one_file_knows_how_blenders_differ():
    knowing = [p for p in sources("splannequin_addon") if asks_the_version(read(p))]
    assert knowing == [ROOT / "splannequin_addon" / "compat.py"]


def test_no_module_of_the_addon_has_both_threads_and_bpy():
    for path in sources("splannequin_addon"):
        names = {name.split(".")[0] for name in imported_at_run_time(path)}
        assert not (names & {"threading", "concurrent", "asyncio"} and names & BLENDER), path


@pytest.mark.parametrize("path", sources("splannequin_addon"), ids=lambda p: str(p.relative_to(ROOT)))
def test_addon_imports_blender_numpy_and_the_contract_only(path: Path):
    wrong = [f"{path}:{line}: {name}" for line, name in imported(path) if not_for_the_addon(name)]
    assert not wrong


@pytest.mark.parametrize("path", sources("torch_backend"), ids=lambda p: str(p.relative_to(ROOT)))
def test_backend_never_imports_blender(path: Path):
    found = imported(path)
    assert not [f"{path}:{line}: {name}" for line, name in found if not_for_the_backend(name)]


@pytest.mark.parametrize("path", sources("torch_backend/contract"), ids=lambda p: p.name)
def test_the_contract_imports_the_standard_library_and_itself(path: Path):
    found = imported(path)
    assert not [f"{path}:{line}: {name}" for line, name in found if not_for_the_contract(name)]


@pytest.mark.parametrize("path", sources("launcher"), ids=lambda p: p.name)
def test_the_launcher_imports_the_standard_library_and_what_needs_no_environment(path: Path):
    allowed = {"torch_backend.contract", "torch_backend.shot", "torch_backend.cards"}
    found = imported(path)
    assert not [
        f"{path}:{line}: {name}"
        for line, name in found
        if name.split(".")[0] not in {"launcher", *sys.stdlib_module_names}
        and ".".join(name.split(".")[:2]) not in allowed
    ]


@pytest.mark.parametrize("path", sources("torch_backend"), ids=lambda p: str(p.relative_to(ROOT)))
def test_a_station_imports_only_stations_before_it(path: Path):
    station = station_of(path.relative_to(ROOT / "torch_backend").with_suffix("").parts)
    if station not in STATIONS:
        return
    allowed = {
        *STATIONS[: STATIONS.index(station) + 1],
        "contract",
        "shot",
        "replaced",
        "replacing",
        "cards",
        "kernel_text",
        "array_types",
        "torch_types",
    }
    wrong = []
    for line, name in imported(path):
        parts = name.split(".")
        if parts[0] == "torch_backend" and len(parts) > 1 and station_of(parts[1:]) not in {*allowed, "__version__"}:
            wrong.append(f"{path}:{line}: {name}")
    assert not wrong


def test_only_the_contract_spells_the_layout_of_a_shot():
    contract = ROOT / "torch_backend" / "contract"
    wrong = []
    for path in [*sources("splannequin_addon"), *sources("torch_backend")]:
        file = path.relative_to(ROOT).as_posix()
        found = layout_names(read(path)) if contract not in path.parents else ()
        wrong += [f"{file}:{line}: {name}" for line, name in found if (file, name) not in FOREIGN_NAMES]
    assert not wrong, "ask contract.ShotFolder, RunFolder or TakeFolder for these paths"


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other, directly or indirectly; `arrows` maps a module to its imports."""

    def reached(start: str) -> set[str]:
        found, waiting = set(), [start]
        while waiting:
            new = arrows[waiting.pop()] - found
            found |= new
            waiting += new
        return found

    beyond = {name: reached(name) for name in arrows}
    groups = {frozenset(reachable for reachable in beyond[name] if name in beyond[reachable]) for name in arrows}
    return sorted(sorted(group) for group in groups if group)


def test_the_scan_sees_a_circle():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_only_one_addon_file_imports_for_type_checking():
    """Every file may import bpy's types. A room that needs data of a later room gets it through `access`."""

    for_types = {
        path.name
        for path in sources("splannequin_addon")
        if any(
            name.startswith("splannequin_addon.")
            for name in {n for _, n in imported(path)} - set(imported_at_run_time(path))
        )
    }
    assert for_types == {"access.py"}


@functools.cache
def addon_modules() -> dict[str, set[str]]:
    """Map from each add-on module, by its dotted name below the add-on, to the add-on modules that it imports."""
    paths = {}
    for path in sources("splannequin_addon"):
        parts = path.relative_to(ROOT / "splannequin_addon").with_suffix("").parts
        paths[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    arrows: dict[str, set[str]] = {}
    for module, path in paths.items():
        names = [name.split(".") for name in imported_at_run_time(path)]
        inside = [n[1:] for n in names if n[0] == "splannequin_addon"]
        targets = {".".join(n) if ".".join(n) in paths else ".".join(n[:-1]) for n in inside}
        assert targets <= paths.keys(), f"{path}: {targets - paths.keys()}"
        arrows[module] = targets - {module}
    return arrows


def level(module: str, arrows: dict[str, set[str]]) -> int:
    """Length of the longest chain of imports that starts with this module, which counts as one."""
    return 1 + max((level(imported_module, arrows) for imported_module in arrows[module]), default=0)


def backwards(arrows: dict[str, set[str]]) -> list[str]:
    """Imports from a room to one that does not come before it."""
    order = {room: place for place, room in enumerate(ROOMS)}
    wrong = []
    for module, targets in arrows.items():
        source_room = module.partition(".")[0]
        for target in sorted(targets):
            target_room = target.partition(".")[0]
            if source_room != target_room and order[target_room] >= order[source_room]:
                wrong.append(f"{module} imports {target}")
            if target.endswith(".step") and source_room != "registration":
                wrong.append(f"{module} imports {target}, which only the registration does")
    return wrong


def test_addon_modules_have_no_import_cycles():
    assert circles(addon_modules()) == []


def test_addon_import_depth_is_bounded():
    arrows = addon_modules()
    assert len(arrows) > 60
    high = {module: level(module, arrows) for module in arrows}
    assert not {module: n for module, n in high.items() if n > LEVELS}


def test_a_room_of_the_addon_imports_only_rooms_before_it():
    assert backwards(addon_modules()) == []


def test_every_room_of_the_addon_has_its_place_in_the_order():
    rooms = {module.partition(".")[0] for module in addon_modules()} - {"", "run_in_bpy"}
    assert rooms == set(ROOMS)


def test_nothing_runs_what_a_file_says():
    files = [ROOT / "splannequin.py", ROOT / "__init__.py"]
    files += [
        path for folder in ("launcher", "torch_backend", "splannequin_addon", "benchmarks") for path in sources(folder)
    ]
    wrong = [f"{path}:{line}: {what}" for path in files for line, what in dangers(read(path))]
    assert not wrong


def test_the_extension_package_imports_nothing_at_module_level():
    top = [node for node in read(ROOT / "__init__.py").body if isinstance(node, (ast.Import, ast.ImportFrom))]
    assert not top


@pytest.mark.parametrize(
    "module", ["torch_backend", "torch_backend.contract", "torch_backend.shot", "torch_backend.cli"]
)
def test_light_modules_load_nothing_heavy(module: str):
    heavy = ("torch", "numpy", "warp", "pycolmap", "OpenImageIO", "av", "cv2", "scipy", "safetensors")
    code = f"import sys, {module}; print([m for m in {heavy!r} if m in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert (ran.stdout.strip(), ran.stderr) == ("[]", "")


def packages(top: str) -> list[str]:
    """Folders of Python files from `top` on, dotted."""
    found = {path.parent for path in sources(top)}
    return sorted(".".join(folder.relative_to(ROOT).parts) for folder in found)


def part_of(name: str, package: str) -> str:
    """File or folder of a package that contains a dotted name; "" outside. `footage.plates` counts separately."""
    parts = name.split(".")
    if parts[:3] == ["torch_backend", "footage", "plates"] and package == "torch_backend":
        return "footage.plates"
    return parts[package.count(".") + 1] if name.startswith(f"{package}.") else ""


@pytest.mark.parametrize("package", [*packages("launcher"), *packages("torch_backend"), *packages("benchmarks")])
def test_packages_have_no_import_cycles(package: str):
    """At any depth, and also for type names: a file that names another's class depends on it."""
    arrows: dict[str, set[str]] = {}
    for path in sources(package.replace(".", "/")):
        module = [*package_of(path), *([] if path.stem == "__init__" else [path.stem])]
        part = part_of(".".join(module), package)
        if part:
            names = (part_of(name, package) for _, name in imported(path))
            arrows.setdefault(part, set()).update(names)
    arrows = {part: {name for name in names if name in arrows and name != part} for part, names in arrows.items()}
    assert circles(arrows) == []


@pytest.mark.parametrize(
    ("found", "count"),
    [
        (dangers(ast.parse("import pickle\nfrom http.server import HTTPServer\ntorch.load(a)\nnp.load(b)")), 3),
        (dangers(ast.parse("np.load(a, allow_pickle=True)\ntorch.load(b, weights_only=True)")), 1),
        (layout_names(ast.parse("path = shot / 'solve' / 'cameras.json'\nrecord['frames']")), 2),
        (filter(not_for_the_addon, ["torch_backend.shot", "torch", "torch_backend.contract.Event", "bpy", "json"]), 2),
        (filter(not_for_the_contract, ["numpy", "torch_backend.shot", "json"]), 2),
        (filter(not_for_the_backend, ["mathutils.Vector", "splannequin_addon.jobs", "torch"]), 2),
        (
            imports(
                ast.parse("def f():\n    import a\n    importlib.import_module('b')\nfrom ..c import d"), ["e", "f"]
            ),
            3,
        ),
        (imports(run_time("if TYPE_CHECKING:\n    import a\nelse:\n    import b"), []), 1),
        (unplaced_children(ast.parse("subprocess.Popen(a, env=b)\nsubprocess.Popen(a, cwd=b)")), 1),
        (backwards({"freeze.takes": {"bake.insertion"}, "bake.insertion": set()}), 1),
        (backwards({"bake.panel": {"freeze.takes"}, "freeze.takes": set()}), 0),
    ],
)
def test_each_scan_sees_what_it_looks_for(found, count: int):
    assert len(list(found)) == count
