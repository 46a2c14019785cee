"""Outputs of a nonlinear plant that depend on inputs directly: each such input becomes a state equal to it.

The papers' outputs are ``h(x, theta)``; that of a battery, ``V = E - R * I``, reads an input, the current.
"""

from __future__ import annotations

import re
from typing import Any

#: Ending of the name of a state that equals an input.
NOW = "_now"


def with_inputs_as_states(fields: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a model in texts with a state, and its equation, for each input that outputs read.

    Definitions that outputs read and that read inputs are written into the outputs.
    """
    inputs, definitions = fields["inputs"], fields["definitions"]
    outputs = {name: _written_out(text, definitions, inputs) for name, text in fields["outputs"].items()}
    read = [name for name in inputs if any(_reads(text, name) for text in outputs.values())]
    if not read:
        return fields
    groups = ("inputs", "definitions", "states", "parameters", "constants", "equations")
    known = {name for group in groups for name in fields[group]}
    states, equations = dict(fields["states"]), dict(fields["equations"])
    for name in read:
        state = _free_name(f"{name}{NOW}", known)
        states[state], equations[state] = inputs[name], f"{state} = {name}"
        outputs = {output: _replaced(text, name, state) for output, text in outputs.items()}
    return {**fields, "states": states, "equations": equations, "outputs": outputs}


def _reads(text: str, name: str) -> bool:
    return re.search(rf"\b{re.escape(name)}\b", text) is not None


def _replaced(text: str, name: str, other: str) -> str:
    return re.sub(rf"\b{re.escape(name)}\b", other, text)


def _written_out(text: str, definitions: dict[str, str], inputs: dict[str, float]) -> str:
    """Return an output with the definitions in it written out that read an input, directly or through others."""
    # A definition may use those before it alone.
    for name in reversed(definitions):
        if _reads(text, name) and _reads_input(name, definitions, inputs):
            text = _replaced(text, name, f"({definitions[name]})".replace("\\", r"\\"))
    return text


def _reads_input(name: str, definitions: dict[str, str], inputs: dict[str, float]) -> bool:
    text = definitions[name]
    before = list(definitions)[: list(definitions).index(name)]
    return any(_reads(text, each) for each in inputs) or any(
        _reads(text, other) and _reads_input(other, definitions, inputs) for other in before
    )


def _free_name(name: str, known: set[str]) -> str:
    while name in known:
        name += "_"
    return name
