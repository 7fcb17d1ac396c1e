"""The vocabulary of names and prose: the glossary's terms are used, and words that a reader stumbles over are not."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Names that do not state what they hold.
VAGUE_NAMES = {
    *("again", "alike", "apart", "bend", "both", "bow", "either", "first", "floor", "foretell", "freshen"),
    *("guess", "halved", "heard", "heed", "in_pairs", "kept", "lesson", "look", "look_again", "looks"),
    *("memory", "nats", "note", "now", "one", "other", "others", "quick_look", "reading", "second_opinion"),
    *("seen", "shot", "spread", "support", "take", "told", "weighed", "without_row_light"),
}
#: Beginnings and ends of names that have a standard form: `min_`, `max_`, `_weight`, `_llr`.
VAGUE_PARTS = re.compile(r"^(least(?!_squares)|most|say_of)_|_nats$|(^|_)(told|foretold|heard|weighed|nats)(_|$)")
#: Glue and coined words, with what to write instead.
PHRASES = {
    r"so many(?:eth|ieth)?": "a number, or `this many`",
    r"of which": "a second sentence",
    r"those that": "the noun",
    r"(?:fore)?tells?|(?:fore)?told": "indicate, predict, estimate, state",
    r"says?|said": "state, report, indicate",
    r"where none (?:does|is|are)": "or None",
    r"nats?": "log-likelihood ratio",
    r"quick looks?|looks? again|looked at again|second opinions?": "pass, attempt",
    r"weighed": "scored, compared",
    r"alike": "similar, equal, correlated",
    r"guess(?:es|ed)?": "estimate",
    r"heed(?:s|ed)?|freshen(?:s|ed)?|lessons?": "update",
    r"not (?:yet )?asked": "not used, not requested",
}
PHRASE = re.compile(r"\b(?:" + "|".join(PHRASES) + r")\b", re.IGNORECASE)
#: This file holds a word in the text of a test picture.
TEXT_IN_A_PICTURE = "lab/simulate/pictures.py"
PAGES = (
    *("README.md", "sample_frames/README.md", "docs/README.md", "docs/architecture.md", "docs/auto_encoder.md"),
    *("docs/calibration.md", "docs/ci.md", "docs/folders.md", "docs/glossary.md", "docs/link.md", "docs/python.md"),
    *("docs/simulator.md", "docs/usage.md", "docs/benchmark.md", "docs/blind.md", "docs/screen.md", "docs/search.md"),
    *("docs/serve.md", "docs/video.md", "models/confidence/README.md", "models/strips/README.md"),
)
#: Limits of a page's words and of the documentation's, code aside, and of the README's lines.
MAX_PAGE_WORDS, MAX_WORDS, MAX_README_LINES = 1500, 20_000, 120


def files(*places: str) -> list[Path]:
    """Python files of some places below `rxcli/`."""
    roots = [ROOT / "rxcli" / place for place in places]
    return sorted(path for root in roots for path in ([root] if root.is_file() else root.rglob("*.py")))


def names(tree: ast.AST) -> Iterator[str]:
    """Names that a module defines: variables, arguments, fields, functions, classes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name


def prose(text: str) -> Iterator[tuple[int, str]]:
    """Comments and strings of a module, runs of comment lines joined, with their line."""
    run: list[str] = []
    start = last = 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            if run and token.start[0] == last + 1:
                run.append(token.string.lstrip("#: "))
            else:
                if run:
                    yield start, " ".join(run)
                run, start = [token.string.lstrip("#: ")], token.start[0]
            last = token.start[0]
        elif token.type in {tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}:
            yield token.start[0], " ".join(token.string.split())
    if run:
        yield start, " ".join(run)


def faults_of(path: Path) -> Iterator[str]:
    """Vague names and phrases of a Python file."""
    text = path.read_text(encoding="utf-8")
    where = path.relative_to(ROOT)
    for name in sorted(set(names(ast.parse(text)))):
        if name.lower().strip("_") in VAGUE_NAMES or VAGUE_PARTS.search(name.lower().strip("_")):
            yield f"{where}: name {name}"
    for line, words in prose(text):
        for match in PHRASE.finditer(words):
            yield f"{where}:{line}: {match[0]!r} in {words[max(match.start() - 50, 0) : match.end() + 40]!r}"


def test_faults_are_found() -> None:
    assert VAGUE_PARTS.search("least_rows")
    assert not VAGUE_PARTS.search("almost_rows")
    found = list(prose('"""What it\n    tells."""\n#: So\n#: many.\nx = f"{y} says"'))
    assert sorted(PHRASE.findall(words) for _, words in found) == [["So many"], ["says"], ["tells"]]


@pytest.mark.parametrize(
    "path",
    sorted({*files(".")} - {*files(TEXT_IN_A_PICTURE)}),
    ids=lambda path: str(path.relative_to(ROOT / "rxcli")),
)
def test_names_and_prose_of_code(path: Path) -> None:
    assert not list(faults_of(path))


def text_of(page: Path) -> str:
    """A page without its blocks of code."""
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_prose_of_pages(page: str) -> None:
    paragraphs = [" ".join(paragraph.split()) for paragraph in text_of(ROOT / page).split("\n\n")]
    assert not [(match[0], paragraph) for paragraph in paragraphs for match in PHRASE.finditer(paragraph)]


def test_pages_are_short() -> None:
    words = {page.name: len(re.findall(r"\S*\w\S*", text_of(page))) for page in (ROOT / "docs").glob("*.md")}
    assert sum(words.values()) <= MAX_WORDS
    assert not {name: count for name, count in words.items() if count > MAX_PAGE_WORDS}
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= MAX_README_LINES


def test_terms_of_the_glossary_are_used() -> None:
    text = " ".join(path.read_text(encoding="utf-8") for path in files(".")).lower().replace("_", " ")
    rows = re.findall(r"^\| (.+?) \|", (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"), re.MULTILINE)
    terms = [term for row in rows for term in re.findall(r"[*`]+([^*`]+)[*`]+", row)]
    assert len(terms) > 40
    assert not [term for term in terms if not re.search(rf"\b{re.escape(term.lower().replace('_', ' '))}", text)]
