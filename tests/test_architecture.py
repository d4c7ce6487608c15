"""The rules of the house, read off the source: who imports whom, what no module does, and what every public name has."""

from __future__ import annotations

import ast
import configparser
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import setuptools

import bbfit

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "bbfit"
MODULES = sorted(PACKAGE.rglob("*.py"))
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in MODULES}

# Lowest first. A module imports from the groups before its own and from its own package, never from another name of its group.
GROUPS = (
    ("checks",),
    ("provenance", "inputs"),
    ("files", "glb", "model_files", "scratch", "threads"),
    ("geometry", "outputs"),
    ("layout",),
    ("images",),
    ("tree_files",),
    ("trees", "blender"),
    ("views",),
    ("operators",),
    ("rendering",),
    ("fitting", "rivals"),
    ("exporting",),
    ("evaluation",),
    ("budget",),
    ("reporting",),
    ("stages", "workers"),
    ("pipeline",),
    ("lod", "sweep", "comparison", "viewing"),
    ("library", "frames"),
    ("forest",),
    ("cli",),
    ("__main__",),
)
LEVEL = {name: level for level, group in enumerate(GROUPS) for name in group}


def relative(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


# Heavy or optional modules, and the only files that import them.
ONLY_IN = {
    "bpy": {
        f"blender/{name}.py"
        for name in (
            "worker",
            "worker_scene",
            "worker_glb",
            "worker_lights",
            "worker_thin",
            "worker_thinning",
            "worker_depth",
            "worker_field",
        )
    },
    "cv2": {"images.py", "fitting/bounds.py"},
    "xatlas": {"exporting/packing.py"},
    "warp": {
        "operators/launching.py",
        "operators/drawing/projector.py",
        *(relative(path) for name in ("fused", "*kernels") for path in PACKAGE.glob(f"operators/*/{name}.py")),
    },
    "ray": {"workers/cluster.py"},
    "yaml": {"sweep/grid.py"},
    "jinja2": {"reporting/html.py"},
    "mitsuba": {"rivals/mesh_rays.py"},
    "drjit": {"rivals/mesh_rays.py"},
    "fast_simplification": {"rivals/decimation.py", "rivals/learned_mesh.py"},
    "DracoPy": {"rivals/draco.py"},
    "playwright": {"frames/browser.py"},
    "pxr": {"forest/usd_stage.py", "tree_files/usd_layers.py"},
}
NOT_AT_IMPORT = ("bpy", "warp", "xatlas", "ray", "matplotlib", "mitsuba", "DracoPy", "fast_simplification", "jinja2", "playwright", "pxr")


def unit(path: Path) -> str:
    """The name under ``bbfit`` that a file belongs to: a package or a module."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything imported, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            for alias in node.names:
                yield node.lineno, f"{node.module}.{alias.name}"


def calls(tree: ast.AST) -> Iterator[tuple[ast.Call, str]]:
    """Every call and the dotted name that is called."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield node, ast.unparse(node.func)


def upward(path: Path, tree: ast.AST) -> list[str]:
    """Imports of a file that do not go downwards."""
    own, wrong = unit(path), []
    if own not in LEVEL:
        return [f"{relative(path)}: give {own!r} a place in GROUPS"]
    for line, name in imports(tree):
        parts = name.split(".")
        if parts[0] != "bbfit":
            continue
        other = parts[1] if len(parts) > 1 else ""
        if other != own and LEVEL.get(other, len(GROUPS)) >= LEVEL[own]:
            wrong.append(f"{relative(path)}:{line} imports {name}")
    return wrong


def test_imports_go_downwards_only() -> None:
    assert len(MODULES) > 10
    wrong = [line for path, tree in TREES.items() if path != PACKAGE / "__init__.py" for line in upward(path, tree)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("file", "source", "allowed"),
    [
        ("geometry/camera.py", "from bbfit.checks import fail", True),
        ("geometry/camera.py", "from bbfit.layout import Frame", False),
        ("fitting/loop.py", "from bbfit.fitting.config import FitConfig", True),
        ("fitting/loop.py", "def f():\n    import bbfit.evaluation.metrics", False),
        ("evaluation/scoring.py", "from bbfit.exporting import cards", True),
        ("exporting/model.py", "from bbfit.evaluation import scoring", False),
        ("views.py", "from bbfit.rendering.dispatch import render", False),
        ("views.py", "from bbfit.images import read_rgba", True),
        ("pipeline.py", "from bbfit import cli", False),
        ("pipeline.py", "from bbfit import fit", False),
        ("pipeline.py", "import bbfit", False),
        ("somewhere.py", "import os", False),
    ],
)
def test_the_import_rule_itself(file: str, source: str, allowed: bool) -> None:
    assert (not upward(PACKAGE / file, ast.parse(source))) == allowed


def test_the_page_on_the_architecture_and_its_picture_show_the_same_layers() -> None:
    layers = [set(group) for group in GROUPS if group != ("__main__",)]
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \d+ \| (.*?) \|", page, re.MULTILINE)
    assert [set(re.findall(r"`(\w+)`", row)) for row in rows] == layers
    picture = (ROOT / "docs" / "figures" / "rooms.svg").read_text(encoding="utf-8")
    heights: dict[int, set[str]] = {}
    for height, name in re.findall(r'<text x="\d+" y="(\d+)" text-anchor="middle"><tspan font-weight="600">(\w+)</tspan>', picture):
        heights.setdefault(int(height), set()).add(name)
    assert [heights[height] for height in sorted(heights, reverse=True)] == layers


def test_packages_do_not_import_their_modules_in_circles() -> None:
    graph = {
        ".".join(path.with_suffix("").relative_to(ROOT).parts).removesuffix(".__init__"): {name for _, name in imports(tree)}
        for path, tree in TREES.items()
        if path != PACKAGE / "__init__.py"
    }
    # "from a.b import c" names either the module a.b.c or c within a.b.
    edges = {m: {n if n in graph else n.rpartition(".")[0] for n in names} & graph.keys() - {m} for m, names in graph.items()}
    while leaves := {module for module, targets in edges.items() if not targets & edges.keys()}:
        edges = {module: targets for module, targets in edges.items() if module not in leaves}
    assert not edges, f"circular imports among {sorted(edges)}"


@pytest.mark.parametrize("module", ONLY_IN)
def test_heavy_modules_are_imported_in_their_one_place(module: str) -> None:
    found = {relative(path) for path, tree in TREES.items() for _, name in imports(tree) if name.split(".")[0] == module}
    assert found <= ONLY_IN[module]


def test_importing_bbfit_loads_nothing_heavy_and_touching_its_names_no_blender() -> None:
    script = f"""
import json, sys
import bbfit
heavy = {NOT_AT_IMPORT!r}
bare = [name for name in heavy if name in sys.modules]
for name in bbfit.__all__:
    getattr(bbfit, name)
print(json.dumps([bare, [name for name in heavy if name in sys.modules]]))
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert json.loads(result.stdout) == [[], []]


def test_the_command_line_starts_without_numpy_and_makes_no_options_for_its_help() -> None:
    script = """
import json, sys
import bbfit.cli.options as options
made = []
options.deferred = lambda command, own=options.deferred: made.append(command.__name__) or own(command)
from bbfit.cli.program import execute
for arguments in (["--help"], ["grow", "--help"]):
    try:
        execute(arguments, program=False)
    except SystemExit:
        made.append("end")
loaded = [name for name in ("numpy", "torch", "scipy", "cv2") if name in sys.modules]
print(json.dumps([made, loaded]))
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert json.loads(result.stdout.splitlines()[-1]) == [["end", "grow_command", "end"], []]


def test_every_package_is_installed() -> None:
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg", encoding="utf-8")
    assert settings["options"]["packages"] == "find:"
    installed = setuptools.find_packages(str(ROOT), include=[settings["options.packages.find"]["include"]])
    folders = {path.parent for path in [*MODULES, ROOT / "bbfit" / "data" / "__init__.py"]}
    assert {".".join(folder.relative_to(ROOT).parts) for folder in folders} == set(installed)


def test_files_are_short() -> None:
    lengths = {relative(path): len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES}
    assert not {name: lines for name, lines in lengths.items() if lines > 400}


def test_no_module_is_named_like_a_public_function_or_a_grab_bag() -> None:
    functions = {name for name in bbfit.__all__ if name.islower()}
    assert {"fit", "render", "evaluate", "export", "run"} <= functions
    names = {part.removesuffix(".py") for path in MODULES for part in path.relative_to(PACKAGE).parts}
    assert not names & functions
    assert not names & {"util", "utils", "helpers", "manager", "base", "common", "misc"}


def test_public_list_is_sorted_and_complete() -> None:
    assert list(bbfit.__all__) == sorted(bbfit.__all__)
    assert list(bbfit.__all__) == dir(bbfit)
    with pytest.raises(AttributeError, match="nonsense"):
        bbfit.nonsense  # noqa: B018


def test_the_library_prints_nothing() -> None:
    printing = [
        f"{relative(path)}:{call.lineno}"
        for path, tree in TREES.items()
        if unit(path) not in ("cli", "__main__")
        for call, name in calls(tree)
        if name in ("print", "sys.stdout.write", "rich.print")
    ]
    assert not printing


def test_nothing_from_a_file_is_ever_executed() -> None:
    dangerous = []
    for path, tree in TREES.items():
        for line, name in imports(tree):
            if name.split(".")[0] in ("pickle", "dill", "joblib", "shelve", "marshal"):
                dangerous.append(f"{relative(path)}:{line} imports {name}")
        for call, name in calls(tree):
            unsafe_call = name in ("eval", "exec", "compile", "torch.load", "torch.save", "os.system", "os.popen", "yaml.load")
            unsafe_option = any(
                keyword.arg in ("shell", "allow_pickle") and not (isinstance(keyword.value, ast.Constant) and keyword.value.value is False)
                for keyword in call.keywords
            )
            if unsafe_call or unsafe_option:
                dangerous.append(f"{relative(path)}:{call.lineno} calls {name}")
    assert not dangerous


def test_no_handler_catches_everything_and_goes_on() -> None:
    """``except BaseException`` is for tidying up before the error is raised again; a sweep records whatever fails in a run."""
    wide = []
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ExceptHandler):
                caught = ast.unparse(node.type) if node.type else ""
                raises_again = any(isinstance(inner, ast.Raise) and inner.exc is None for inner in ast.walk(node))
                goes_on = not isinstance(node.body[-1], ast.Raise) and relative(path) != "workers/tasks.py"
                if (caught in ("", "Exception") and goes_on) or ("BaseException" in caught and not raises_again):
                    wide.append(f"{relative(path)}:{node.lineno}")
    assert not wide


def public(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]]:
    """Public functions, classes and methods with their qualified names."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node.body, f"{prefix}{node.name}.")


def documented(name: str, node: ast.stmt | None) -> bool:
    """Whether a statement is a string on its own, which says what the field above it, ``name``, is."""
    return name.startswith("_") or (isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str))


def test_every_public_name_and_module_says_what_it_is_for() -> None:
    silent = [relative(path) for path, tree in TREES.items() if tree.body and not ast.get_docstring(tree)]
    for path, tree in TREES.items():
        silent += [f"{relative(path)}: {name}" for name, node in public(tree.body) if not ast.get_docstring(node)]
    assert not silent


def test_every_dataclass_field_is_documented_below_it() -> None:
    """Save those whose type is a dataclass of ours: it says itself what it is."""
    ours = {node.name for _, _, node in dataclasses()}
    bare = []
    for path, name, node in dataclasses():
        for field, below in zip(node.body, [*node.body[1:], None], strict=True):
            if not isinstance(field, ast.AnnAssign) or ours & set(ast.unparse(field.annotation).split(" | ")):
                continue
            if not documented(ast.unparse(field.target), below):
                bare.append(f"{relative(path)}: {name}.{ast.unparse(field.target)}")
    assert not bare


def test_public_functions_take_at_most_seven_arguments() -> None:
    """Save commands, whose arguments are the command line's options, and Warp's kernels and functions, which no Python code calls."""
    wide = []
    for path, tree in TREES.items():
        if path == PACKAGE / "cli" / "commands.py" or path == PACKAGE / "cli" / "studies.py":
            continue
        for name, node in public(tree.body):
            if not isinstance(node, ast.ClassDef) and not any(ast.unparse(by).startswith("wp.") for by in node.decorator_list):
                arguments = {a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)} - {"self", "cls"}
                if len(arguments) > 7:
                    wide.append(f"{relative(path)}: {name} takes {len(arguments)}")
    assert not wide


def dataclasses() -> Iterator[tuple[Path, str, ast.ClassDef]]:
    """Public dataclasses: file, qualified name, definition."""
    for path, tree in TREES.items():
        for name, node in public(tree.body):
            if isinstance(node, ast.ClassDef) and any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
                yield path, name, node


def test_dataclasses_are_frozen() -> None:
    thawed = [
        f"{relative(path)}: {name}"
        for path, name, node in dataclasses()
        if not any("frozen=True" in ast.unparse(decorator) for decorator in node.decorator_list)
    ]
    assert not thawed


def text_files() -> Iterator[Path]:
    """Everything written by hand."""
    endings = {".py", ".md", ".txt", ".cfg", ".toml", ".json", ".ipynb", ".mjs", ".js", ".yml", ".yaml", ".sh", ""}
    for folder in ("bbfit", "tests", "scripts", "notebooks", "data", ".ci"):
        for path in sorted((ROOT / folder).rglob("*")):
            built = {"node_modules", "__pycache__", ".ipynb_checkpoints"} & set(path.parts)
            if path.is_file() and path.suffix in endings and not built:
                yield path
    yield from (path for path in sorted(ROOT.iterdir()) if path.is_file() and path.suffix in endings and path.name != ".git")


def test_no_file_names_a_path_of_one_machine() -> None:
    machine = re.compile(r"(?<![\w.])/(work|home|root|Users)/\w")
    named = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in text_files()
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if machine.search(line)
    ]
    assert not named
