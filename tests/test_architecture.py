"""The import graph is what the listing promises; a failure says where the code belongs.

ARCHITECTURE in one paragraph: eight stages, eight folders. `stage.py` takes files to files; its neighbours do
the arithmetic, arrays in and arrays out, and know nothing of workspaces. Imports point to lower floors.
"""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "corrsfm"

STAGES = ("images", "features", "pairs", "matches", "prune", "database", "reconstruction", "report")
# From the ground up; a room may import the rooms of the floors below it.
FLOORS: list[tuple[str, set[str]]] = [
    (
        "what everything may use",
        {
            "corrsfm",
            "errors",
            "camera",
            "types",
            "geometry",
            "descriptors",
            "distances",
            "graph",
            "files",
            "hdf5",
            "disk",
            "machine",
            "cluster",
        },
    ),
    ("the options", {"config"}),
    ("what lies on disk, COLMAP's data and the network", {"workspace", "colmap", "model"}),
    ("the arithmetic of the stages, which knows no workspace", {*STAGES, "labelled"}),
    ("the stages, files to files", {f"{stage}.stage" for stage in STAGES}),
    (
        "a whole run, its forecast, what comes in before it, and what is done with a finished scene",
        {"pipeline", "forecast", "importing", "export", "finished"},
    ),
    ("many runs, measuring, training", {"batch", "evaluation", "training"}),
    ("the command line", {"cli", "__main__"}),
]
FLOOR = {room: number for number, (_, rooms) in enumerate(FLOORS) for room in rooms}
# On one floor only these imports are allowed: importer → imported, with the reason.
ON_ONE_FLOOR: dict[tuple[str, str], str] = {
    ("camera", "errors"): "a camera that is not possible says so",
    ("types", "camera"): "the record stands beside the others",
    ("types", "errors"): "matches of other features are refused in one place",
    ("files", "disk"): "what a full disk and a closed folder say has one home",
    ("files", "errors"): "a file that cannot be read says so",
    ("cluster", "errors"): "a cluster that cannot be used says so",
    ("cluster", "machine"): "processes of this machine start in one way",
    ("machine", "errors"): "a device that cannot be used says so",
    ("distances", "descriptors"): "what a whole number of a descriptor is has one home",
    ("graph", "errors"): "long lists of names are cut in one place",
    ("graph", "types"): "a pair is two names",
    ("workspace", "colmap"): "a stage asks whether the database it starts from is whole",
    ("report", "images"): "photos are decoded in one place, images/photos.py",
    ("training", "evaluation"): "training is judged by evaluation's metrics",
    ("finished", "pipeline"): "an addition checks its options as a run does, before any work",
    ("__main__", "cli"): "python -m corrsfm",
}
# The rooms that may import a third-party package.
OWNERS: dict[str, set[str]] = {
    "cv2": {"images", "features", "report", "prune", "evaluation"},
    "h5py": {"hdf5", "workspace", "labelled", "importing", "export"},
    "pycolmap": {
        "colmap", "images", "features", "pairs", "prune", "database", "reconstruction", "report",
        "export", "finished", "evaluation",
    },
    "torch": {"model", "machine", "distances", "features", "matches", "prune", "training", "evaluation"},
    "click": {"cli"},
    "tqdm": {"cli", "workspace", "images.stage", "reconstruction.stage", "batch", "training", "evaluation"},
    "plotly": {"report", "evaluation"},
    "PIL": {"images"},
    "pillow_heif": {"images"},
    "poselib": {"database", "evaluation"},
}  # fmt: skip


def room_of(name: str) -> str:
    """The room of a dotted name below corrsfm; `stage` modules are rooms of their own."""
    parts = name.split(".")
    if parts[1:2] == ["stage"]:
        return ".".join(parts[:2])
    return parts[0] if parts[0] in FLOOR else "corrsfm"


def name_of(path: Path) -> str:
    """Dotted name of a file below corrsfm."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts) or "corrsfm"


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
            # A module imported by name from its package is an import of the module.
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def all_files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def internal_imports() -> list[tuple[str, str, str]]:
    """File, its room, and the dotted name below corrsfm that it imports."""
    return [
        (str(path.relative_to(PACKAGE)), room_of(name_of(path)), name.removeprefix("corrsfm."))
        for path in all_files()
        for name in imports_of(path)
        if name.startswith("corrsfm.")
    ]


def test_every_room_stands_on_a_floor() -> None:
    rooms = {name_of(path).split(".")[0] for path in all_files()}
    assert len(rooms) > 20
    known = {room.split(".")[0] for room in FLOOR}
    assert rooms <= known, (
        f"new at the top of the package: {sorted(rooms - known)}. Most code belongs into a room that exists, "
        f"see the floors in tests/test_architecture.py: {sorted(known)}"
    )
    assert all((PACKAGE / stage / "stage.py").is_file() for stage in STAGES)


def test_imports_point_to_lower_floors() -> None:
    edges = internal_imports()
    assert len(edges) > 300
    wrong = []
    for file, room, name in edges:
        target = room_of(name)
        if room == target or target == "corrsfm" or (room, target) in ON_ONE_FLOOR:
            continue
        if FLOOR[target] >= FLOOR[room]:
            wrong.append(
                f"{file} ({FLOORS[FLOOR[room]][0]}) imports {name} ({FLOORS[FLOOR[target]][0]}): move what "
                f"both need to a floor below {room}, or the caller to a floor above {target}"
            )
    assert not wrong, "\n".join(wrong)


def test_exceptions_on_one_floor_are_needed() -> None:
    used = {(room, room_of(name)) for _, room, name in internal_imports()}
    assert ON_ONE_FLOOR.keys() <= used, (
        f"no longer imported: {ON_ONE_FLOOR.keys() - used}; drop the exception"
    )


def test_arithmetic_knows_no_workspace() -> None:
    wrong = [
        f"{file} imports {name}: read and write in {room}/stage.py and pass arrays in"
        for file, room, name in internal_imports()
        if room in (*STAGES, "labelled") and room_of(name) == "workspace"
    ]
    assert not wrong, "\n".join(wrong)


def test_stages_do_not_import_each_other() -> None:
    wrong = [
        f"{file} imports {name}: data passes through files and corrsfm.types; compose in pipeline.py"
        for file, room, name in internal_imports()
        if room.split(".")[0] in STAGES
        and name.split(".")[0] in STAGES
        and room.split(".")[0] != name.split(".")[0]
        and not name.startswith("images.photos.")
    ]
    assert not wrong, "\n".join(wrong)


def test_inference_imports_neither_training_nor_evaluation() -> None:
    wrong = [
        f"{file} imports {name}: what a reconstruction needs must not depend on measuring or training"
        for file, room, name in internal_imports()
        if room_of(name) in ("training", "evaluation") and room not in ("training", "evaluation", "cli")
    ]
    assert not wrong, "\n".join(wrong)


def test_training_uses_only_the_metrics_and_estimators_of_evaluation() -> None:
    used = {
        name for _, room, name in internal_imports() if room == "training" and name.startswith("evaluation.")
    }
    wrong = [name for name in used if not name.startswith(("evaluation.metrics.", "evaluation.two_view."))]
    assert used and not wrong, f"{wrong}: training may use evaluation.metrics and evaluation.two_view only"


@pytest.mark.parametrize("package", sorted(OWNERS))
def test_third_party_packages_are_imported_by_their_owners_only(package: str) -> None:
    users = {
        room_of(name_of(path))
        for path in all_files()
        if any(name.split(".")[0] == package for name in imports_of(path))
    }
    assert users, f"nothing imports {package}"
    wrong = {user for user in users if not {user, user.split(".")[0]} & OWNERS[package]}
    assert not wrong, (
        f"{sorted(wrong)} import {package}; its owners are {sorted(OWNERS[package])}: call one of them"
    )


def test_only_the_command_line_prints_or_exits() -> None:
    wrong = []
    for path in all_files():
        if room_of(name_of(path)) in ("cli", "__main__"):
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
        "import corrsfm.database.write, numpy as np, io\n"
        "np.savez_compressed(io.BytesIO(), a=np.arange(9999))",
    ],
)
def test_compression_survives_pycolmap(code: str) -> None:
    # pycolmap's wheel exports zlib's symbols; loaded first, it makes the next compression abort the process.
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
