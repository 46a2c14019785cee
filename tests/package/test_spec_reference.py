"""The references of the site: every key of the schema is explained with an example that is YAML; options are code."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from obsynth.specs import schema, schema_options, schema_plants, schema_sections, schema_values

DOCS = Path(__file__).parents[2] / "docs"
PARTS = (schema_values, schema_options, schema_plants, schema_sections, schema)


@pytest.fixture(scope="module")
def spec_keys() -> Iterator[object]:
    sys.path.insert(0, str(DOCS / "_ext"))
    try:
        import spec_keys

        yield spec_keys
    finally:
        sys.path.remove(str(DOCS / "_ext"))


def sections() -> dict[str, type]:
    """Return the sections of the schema that have keys of their own, by name."""
    kinds = (kind for part in PARTS for kind in vars(part).values() if isinstance(kind, type))
    return {kind.__name__: kind for kind in kinds if issubclass(kind, schema_values.Section) and kind.model_fields}


#: Sections with a single key, which the reference explains within other sections.
WITHIN_OTHERS = {"NamesFile", "OutputPick", "StatePick"}


def test_every_key_of_the_schema_is_explained(spec_keys) -> None:
    known = sections()
    assert set(known) - WITHIN_OTHERS == set(spec_keys.KEYS) - {"Constant"}
    for name in set(known) - WITHIN_OTHERS:
        assert set(spec_keys.KEYS[name]) == set(known[name].model_fields), name


def test_every_section_stands_on_the_page(spec_keys) -> None:
    shown = [name for _, name, _ in (*spec_keys.SECTIONS, *spec_keys.OPTION_SECTIONS)]
    assert sorted(shown) == sorted(spec_keys.KEYS)


def test_examples_are_yaml_and_meanings_are_sentences(spec_keys) -> None:
    for section, keys in spec_keys.KEYS.items():
        for key, (unit, meaning, example) in keys.items():
            YAML(typ="safe", pure=True).load(f"{key}: {example}")
            assert meaning.endswith("."), (section, key)
            assert not unit.endswith("."), (section, key)


def test_options_in_the_reference_of_commands_are_code_that_can_be_copied(spec_keys) -> None:
    from references import command_reference

    page = re.sub(r"```.*?```", "", command_reference(), flags=re.DOTALL)
    assert "`--map SIGNAL=COLUMN`" in page
    # Outside of code two hyphens would be printed as a dash, and a bar of a choice with the backslash of the table.
    assert re.findall(r".{0,30}--[a-z][^|]{0,20}", re.sub(r"`[^`]*`", "", page)) == []
    assert "`--outliers gate\\|huber\\|none`" in page
    assert "\\\\|" not in page
