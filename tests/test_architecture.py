"""The import graph is what ARCHITECTURE says: layers point down, each package has owners, help is cheap."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "corrsfm"

LAYERS: dict[str, int] = {
    "corrsfm": 0,
    "errors": 0,
    "types": 0,
    "options": 0,
    "config": 0,
    "geometry": 0,
    "files": 0,
    "workspace": 1,
    "cameras": 1,
    "listing": 1,
    "images": 1,
    "index": 1,
    "retrieval": 1,
    "store": 1,
    "journal": 1,
    "machine": 1,
    "colmap": 1,
    "calibration": 1,
    "oanet": 1,
    "compact": 1,
    "model": 1,
    "features": 2,
    "pairs": 2,
    "matches": 2,
    "prune": 2,
    "database": 2,
    "reconstruction": 2,
    "report": 2,
    "resume": 3,
    "run": 3,
    "summary": 3,
    "mapping": 3,
    "pipeline": 3,
    "batch": 3,
    "benchmark": 3,
    "evaluation": 3,
    "training": 4,
    "cli": 5,
    "__main__": 5,
}
STAGES = {name for name, layer in LAYERS.items() if layer == 2}
# Inside a layer only these imports are allowed: importer → imported.
SAME_LAYER: set[tuple[str, str]] = {
    ("geometry", "types"),
    ("types", "errors"),
    ("options", "errors"),
    ("config", "errors"),
    ("config", "options"),
    ("files", "errors"),
    ("images", "cameras"),
    ("images", "listing"),
    ("index", "cameras"),
    ("index", "images"),
    ("index", "workspace"),
    ("store", "journal"),
    ("pipeline", "resume"),
    ("pipeline", "summary"),
    ("summary", "resume"),
    ("pipeline", "mapping"),
    ("mapping", "resume"),
    ("run", "pipeline"),
    ("run", "resume"),
    ("evaluation", "pipeline"),
    ("compact", "oanet"),
    ("__main__", "cli"),
}
OWNERS: dict[str, set[str]] = {
    "cv2": {"images", "features", "report", "prune", "evaluation"},
    "h5py": {"store", "oanet", "compact", "training"},
    "pycolmap": {
        "calibration", "cameras", "colmap", "images", "features", "pairs", "prune", "database",
        "reconstruction", "report", "evaluation", "training",
    },
    "torch": {"model", "machine", "matches", "prune", "benchmark", "training", "evaluation"},
    "click": {"cli"},
    "tqdm": {"cli", "mapping", "resume", "batch", "training", "evaluation"},
    "plotly": {"report", "evaluation"},
    "poselib": {"evaluation", "training"},
}  # fmt: skip


def unit_of(path: Path) -> str:
    """The name in LAYERS that a file belongs to: a module, or the package it lies in."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return "corrsfm" if parts == ("__init__",) else parts[0]


def imports_of(path: Path) -> Iterator[str]:
    """Dotted names a file imports anywhere, those for type checking only left out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")
        for statement in node.body
        for inner in ast.walk(statement)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            if node.module == "corrsfm":
                yield from (f"corrsfm.{alias.name}" for alias in node.names)
            else:
                yield node.module


def all_files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def internal_edges() -> list[tuple[Path, str, str]]:
    edges = []
    for path in all_files():
        for name in imports_of(path):
            parts = name.split(".")
            if parts[0] == "corrsfm" and len(parts) > 1:
                target = parts[1] if parts[1] in LAYERS else "corrsfm"
                edges.append((path, unit_of(path), target))
    return edges


def test_every_module_has_a_layer() -> None:
    units = {unit_of(path) for path in all_files()}
    assert len(units) > 20
    assert units <= set(LAYERS), f"give {units - set(LAYERS)} a layer in tests/test_architecture.py"


def test_imports_point_to_lower_layers() -> None:
    edges = internal_edges()
    assert len(edges) > 50
    wrong = [
        f"{path.relative_to(PACKAGE)} (layer {LAYERS[unit]}) imports {target} (layer {LAYERS[target]}): "
        "move the shared part down or the caller up"
        for path, unit, target in edges
        if unit != target
        and target != "corrsfm"
        and (unit, target) not in SAME_LAYER
        and LAYERS[target] >= LAYERS[unit]
    ]
    assert not wrong, "\n".join(wrong)


def test_stages_do_not_import_each_other() -> None:
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {target}: pass data through corrsfm.types, compose in pipeline"
        for path, unit, target in internal_edges()
        if unit in STAGES and target in STAGES and unit != target
    ]
    assert not wrong, "\n".join(wrong)


def test_inference_imports_neither_training_nor_evaluation() -> None:
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {target}"
        for path, unit, target in internal_edges()
        if target in ("training", "evaluation") and unit not in (target, "cli", "training")
    ]
    assert not wrong, "\n".join(wrong)


def test_training_uses_only_the_metrics_and_estimators_of_evaluation() -> None:
    allowed = {"corrsfm.evaluation.metrics", "corrsfm.evaluation.methods", "corrsfm.evaluation.two_view"}
    used = {
        name
        for path in (PACKAGE / "training").rglob("*.py")
        for name in imports_of(path)
        if name.startswith("corrsfm.evaluation")
    }
    assert used <= allowed, used - allowed


@pytest.mark.parametrize("package", sorted(OWNERS))
def test_third_party_packages_are_imported_by_their_owners_only(package: str) -> None:
    users = {
        unit_of(path)
        for path in all_files()
        if any(name.split(".")[0] == package for name in imports_of(path))
    }
    assert users, f"nothing imports {package}"
    assert users <= OWNERS[package], (
        f"{users - OWNERS[package]} import {package}; its owners are {OWNERS[package]}"
    )


def test_only_the_command_line_prints_or_exits() -> None:
    wrong = []
    for path in all_files():
        if unit_of(path) in ("cli", "__main__"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("print", "sys.exit", "exit", "quit"):
                wrong.append(f"{path.relative_to(PACKAGE)}:{node.lineno}")
    assert not wrong, wrong


def test_no_module_is_named_after_nothing() -> None:
    assert not [p for p in all_files() if p.stem in ("utils", "util", "common", "helpers", "misc")]


def test_help_imports_no_heavy_package() -> None:
    code = (
        "import sys\n"
        "from click.testing import CliRunner\n"
        "from corrsfm.cli import main\n"
        "for arguments in ([], *[[name] for name in main.commands]):\n"
        "    assert CliRunner().invoke(main, [*arguments, '--help']).exit_code == 0, arguments\n"
        "print(sorted({'torch', 'cv2', 'pycolmap', 'h5py', 'plotly'} & set(sys.modules)))\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "code",
    [
        "import corrsfm, pycolmap, zlib; zlib.compress(bytes(100_000))",
        "import corrsfm, pycolmap, cv2, numpy as np, tempfile, os\n"
        "name = os.path.join(tempfile.mkdtemp(), 'x.png')\n"
        "assert cv2.imwrite(name, np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8))",
        "import corrsfm.database, numpy as np, io; np.savez_compressed(io.BytesIO(), a=np.arange(9999))",
    ],
)
def test_compression_survives_pycolmap(code: str) -> None:
    # pycolmap's wheel exports zlib's symbols; loaded first, it makes the next compression abort the process.
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
