"""Words of our own that a control engineer could not guess: neither texts nor names may hold them."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest

import obsynth
from obsynth.methods.automatic import FaultFigures

ROOT = Path(__file__).parents[2]
#: What is read: sources and templates, documentation, notebooks, and the notes of the designs.
PATTERNS = ("src/**/*.py", "src/**/*.pyi", "src/**/*.c", "docs/**/*.md", "docs/**/*.py", "notebooks/*.py")
FILES = sorted(
    path for pattern in (*PATTERNS, "designs/*/NOTES.md") for path in ROOT.glob(pattern) if "made" not in path.parts
)
FILES += [ROOT / name for name in ("README.md", "CONTRIBUTING.md")]

#: By expression, the field's term. Letters with a line below count as parts of names: `pull_of_the_start` is found.
WORDS = {
    r"forgets?|forgot(ten)?|forgetful": "2 % settling time, or: the initial-condition response has settled",
    r"(die|dies|died|dying)[ _]out": "decays",
    r"(samples?|rows?)(\(s\))? late": "delayed by N samples",
    r"pull of the start": "initial-condition response",
    r"foreseen|heard": "predicted, received",
    r"broken promise": "norm excess",
    r"lively|hopeful": "fast, promising",
    r"drowns?|drowned": "at rounding level",
    r"honest(ly)?": "assumed",
    r"rest point": "DC gain",
    r"as meant": "unquoted",
    r"nobody (watches|asked for|cleaned)": "not used",
    r"held to walk": "random-walk intensity",
    r"without showing|nothing shows|never shows|shows in no output": "output-nulling, or unobservable",
    r"hides whole trajectories": "output-nulling",
    r"told apart|tells? (them|the two|faults) apart|can(not)? be told from": "distinguished",
    r"malformed input:": "what is wrong",
    r"what delay buys|what is promised|worst gain": "deviation against delay, claims, largest gain",
    r"wait(s|ed)? for ever": "blocks",
}
#: Names as they were written.
NAMES = {
    "WayBack": "smoother gain",
    "Descent": "gamma iteration",
    "Drive": "scenario signals",
    r"leak_\w+|LEAK_\w+|\w+_leaks?": "gain from unknown inputs",
}


def found_in(text: str) -> list[str]:
    """Return the words in a text, with the field's term for each."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text).replace("_", " ").lower()
    spaced = re.sub(r"\s+", " ", spaced)
    return [
        f"{hit.group()!r}: {term}"
        for words, where in ((WORDS, spaced), (NAMES, text))
        for word, term in words.items()
        for hit in re.finditer(rf"\b(?:{word.replace('[ _]', ' ')})\b", where)
    ]


@pytest.mark.parametrize(
    ("text", "hits"),
    [
        ("class WayBack:", 1),
        ("pull_of_the_start(observer)", 1),
        ("errors die\n    out in the end", 1),
        ("the forgetting factor lambda", 0),
        ('faults={"leak": Step()}', 0),
        ("delayed by two samples, lately", 0),
    ],
)
def test_words_are_found_in_names_and_over_the_ends_of_lines(text: str, hits: int) -> None:
    assert len(found_in(text)) == hits


def test_sources_and_documentation_use_the_terms_of_the_field() -> None:
    assert len(FILES) > 300
    found = {str(path.relative_to(ROOT)): found_in(path.read_text(encoding="utf-8")) for path in FILES}
    assert {path: words for path, words in found.items() if words} == {}


def test_the_name_that_was_changed_still_answers() -> None:
    figures = FaultFigures("torque", 0.1, 0.2, 1.0, 1.0, 5.0, 0.01, unknown_input_gain=0.25)
    with pytest.warns(DeprecationWarning, match="leak is now unknown_input_gain"):
        assert figures.leak == 0.25
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert figures.unknown_input_gain == 0.25


#: A text within a line, and a name with a line below in it that is neither quoted nor called.
TEXT, NAME = re.compile(r'"([^"\n]*)"'), re.compile(r"(?<![\w.`'{-])[a-z]+_\w+(?![\w(`'=.:])")


def named_in_prose(source: str, names: set[str]) -> set[str]:
    """Return such names in the texts of a module that have several words; documentation is left out."""
    prose = (text for line in source.splitlines() if '"""' not in line for text in TEXT.findall(line))
    return {name for text in prose if text.count(" ") >= 3 for name in NAME.findall(text)} & names


def test_messages_name_no_function_that_only_we_know() -> None:
    sources = [path.read_text("utf-8") for path in (ROOT / "src").rglob("*.py")]
    whole = "\n".join(sources)
    # What a user knows: public names, and those of arguments and fields.
    known = {*obsynth.__all__, *obsynth.conditions.__all__, *obsynth.plotting.__all__, *re.findall(r"(\w+)[=:]", whole)}
    names = set(re.findall(r"^def (\w+)", whole, flags=re.MULTILINE)) - known
    assert "listed_sets" in names
    assert set().union(*(named_in_prose(source, names) for source in sources)) == set()
    assert named_in_prose('raise ValueError(f"{count} sets are listed_sets for you")', {"listed_sets"})
