"""The directions in which modules may import one another, held by walking the source."""

import ast
from pathlib import Path

import pytest

import rxcli

ROOT = Path(rxcli.__file__).parent
#: What everything may import.
BASE = {"rxcli", "rxcli.errors", "rxcli.outputs", "rxcli.resources"}
DATA = BASE | {"rxcli.types", "rxcli.protocol", "rxcli.profiles"}
#: What every stage may stand on beside the data model.
GROUND = DATA | {"rxcli.numerics", "rxcli.receiver.light"}
#: Rooms of the receiver that turn one thing into the next, and know nothing of one another.
STAGES = ("plane", "screen", "camera", "sync", "channel", "decode")
#: Rooms that wire the stages; each uses those before it.
WIRING = ("frame", "still", "search", "clip", "receive")
#: Rooms and files of `rxcli/`: the listing alone shows the way of the data.
MAX_FOLDERS, MAX_FILES = 9, 9
#: Too heavy to be loaded by a module that does not need it at once (milliseconds each on import: 70 to 1000).
HEAVY = {"cv2", "rawpy", "av", "onnxruntime", "matplotlib", "scipy", "skimage", "simplejpeg", "tifffile"}
HEAVY |= {"distributed", "dask", "pyarrow", "torch", "onnx", "lensfunpy", "pillow_heif", "tqdm", "aiohttp", "segno"}


def module_name(path: Path) -> str:
    parts = ("rxcli", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): ast.parse(path.read_text(encoding="utf-8")) for path in ROOT.rglob("*.py")}


def imports(tree: ast.AST) -> set[str]:
    """Modules that `tree` imports, wherever in it: `from rxcli import x` counts as rxcli.x where that is a module."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert node.module is not None
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= (names & MODULES.keys()) or {node.module}
    return found


def imports_at_load(tree: ast.Module) -> set[str]:
    """Modules that are imported when the module is: not inside functions, not for type checkers alone."""
    found: set[str] = set()
    for node in tree.body:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            found |= imports(ast.Module([node], []))
        elif isinstance(node, ast.ClassDef):
            found |= imports_at_load(ast.Module(node.body, []))
        elif isinstance(node, ast.Try):
            found |= imports_at_load(ast.Module([*node.body, *node.orelse], []))
    return found


def own(names: set[str]) -> set[str]:
    return {name for name in names if name.split(".")[0] == "rxcli"}


def below(*folders: str) -> list[str]:
    """Modules in some folders, named as they are imported."""
    return sorted(name for name in MODULES for folder in folders if f"{name}.".startswith(f"rxcli.{folder}."))


def test_the_walk_sees_imports_of_every_form() -> None:
    tree = ast.parse(
        "import rxcli.profiles\nfrom rxcli import protocol\ndef f():\n    from rxcli.types import Frame\n    import cv2"
    )
    known = {"rxcli.profiles", "rxcli.protocol", "rxcli.types", "cv2"}
    assert imports(tree) == known
    assert imports_at_load(tree) == known - {"rxcli.types", "cv2"}


def test_the_listing_is_short() -> None:
    shown = [path for path in ROOT.iterdir() if path.name != "__pycache__" and not path.name.startswith("_data")]
    assert sum(path.is_dir() for path in shown) <= MAX_FOLDERS
    assert sum(path.suffix == ".py" for path in shown) <= MAX_FILES


def test_every_part_of_the_receiver_is_a_room() -> None:
    rooms = below(*(f"receiver.{room}" for room in ("light", *STAGES, *WIRING)))
    assert rooms == [name for name in below("receiver") if name != "rxcli.receiver"]


@pytest.mark.parametrize("room", [*STAGES, *WIRING])
def test_stages_know_nothing_of_each_other_and_only_the_wiring_joins_them(room: str) -> None:
    allowed = GROUND | set(below(f"receiver.{room}"))
    if room in WIRING:
        before = (*STAGES, *WIRING[: WIRING.index(room)])
        allowed |= {"rxcli.options", "rxcli.receiver", *below(*(f"receiver.{room}" for room in before))}
    for name in below(f"receiver.{room}"):
        assert own(imports(MODULES[name])) <= allowed, name


@pytest.mark.parametrize(
    ("room", "allowed"),
    [
        ("ingest", ()),
        ("link", ()),
        ("receiver", ()),
        ("results", ("receiver", "ingest", "link")),
        ("runs", ("receiver", "ingest", "results", "link")),
        ("calibrate", ("receiver", "ingest", "results")),
        ("web", ("receiver", "ingest", "results", "runs", "link")),
    ],
)
def test_data_flows_down_the_listing(room: str, allowed: tuple[str, ...]) -> None:
    """A room uses those before it; the laboratory and the command line use them all."""
    for name in below(room):
        beside = own(imports(MODULES[name])) - GROUND - {"rxcli.options"} - set(below(room, *allowed))
        assert not beside, (name, beside)


def test_no_module_imports_itself_through_others() -> None:
    below = {name: own(imports(tree)) - {name} for name, tree in MODULES.items()}
    while leaves := [name for name, found in below.items() if not found & below.keys()]:
        for name in leaves:
            del below[name]
    assert not below, "in circles, or above them"


@pytest.mark.parametrize(
    ("places", "allowed"),
    [
        (("protocol", "types", "errors", "outputs", "resources"), BASE),
        (("profiles", "options"), DATA),
        # A wrong equation shared with the receiver would cancel in every round trip.
        (("lab.simulate",), BASE | {"rxcli.protocol", "rxcli.profiles", *below("lab.simulate")}),
        # Reports know results only.
        (
            ("results.record", "results.report", "results.truth"),
            DATA | {"rxcli.results.record", "rxcli.results.columns"},
        ),
    ],
    ids=["base", "data", "simulator", "reports"],
)
def test_what_some_stand_on(places: tuple[str, ...], allowed: set[str]) -> None:
    for name in below(*places):
        assert own(imports(MODULES[name])) <= allowed, name


@pytest.mark.parametrize(
    ("library", "users"),
    [
        ("torch", ("lab.training",)),
        ("click", ("cli",)),
        ("rxcli.cli", ("cli",)),
        ("rxcli.receiver.frame", ("receiver", "lab.training")),
        ("rxcli.receiver.receive", ("calibrate", "cli", "lab", "runs", "web")),
    ],
)
def test_what_is_imported_by_some_alone(library: str, users: tuple[str, ...]) -> None:
    """Only training needs torch, nothing below imports the command line, and only those above it call the receiver."""
    importers = {
        name for name, tree in MODULES.items() if any(f"{f}.".startswith(f"{library}.") for f in imports(tree))
    }
    assert importers <= {"rxcli", *below(*users)}


def test_protocol_is_pure() -> None:
    assert {found.split(".")[0] for found in imports(MODULES["rxcli.protocol"])} <= {
        *("__future__", "collections", "functools", "itertools", "math", "typing", "numpy", "rxcli")
    }


@pytest.mark.parametrize("name", sorted(MODULES.keys() - set(below("lab", "calibrate"))))
def test_heavy_libraries_are_imported_where_they_are_used(name: str) -> None:
    """The laboratory and calibration are loaded by their own commands alone."""
    found = {other.split(".")[0] for other in imports_at_load(MODULES[name])} & HEAVY
    # Loaded when a file of their kind comes, or when a page is served.
    readers = {"rxcli.ingest.jpeg", "rxcli.ingest.raw", "rxcli.ingest.video", "rxcli.web.server"}
    assert not found or name in readers, found


@pytest.mark.parametrize("name", ["main", "groups", "config", "kinds", "common"])
def test_help_loads_quickly(name: str) -> None:
    """numpy, and what imports it, would more than double the time of `vlc-rx --help`; commands load when they run."""
    name = f"rxcli.cli.{name}"
    found = imports_at_load(MODULES[name])
    assert not {other for other in found if other.split(".")[0] == "numpy"}
    assert own(found) <= {"rxcli", "rxcli.errors", *below("cli")}
