r"""A nonlinear plant as constant matrices beside scalar nonlinearities of linear combinations of its states.

.. math::
    \begin{bmatrix} I & 0 \\ 0 & 0 \end{bmatrix} z' = A z + B u + c + \sum_k w_k f_k(V_k z + U_k u), \qquad
    y = C z + c_y + \sum_k w_{y,k} f_k(V_k z + U_k u)

with z the differential states and the faults (parameters that are estimated, :math:`\theta' = 0`), then the algebraic
states.  Arguments of the nonlinearities are the largest linear sub-expressions of the texts, each once, however often
it occurs.  Coefficients are exact rationals until the end, where each entry is rounded to double precision once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.expressions import NAMED_NUMBERS, Expression, parse_expression
from obsynth.numerics.suggestions import quoted_names, there_are
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_equations import equation_of
from obsynth.plants.scheduling import TEXTS_OF_OPERATIONS
from obsynth.plants.signal_names import index_of

#: Arguments of nonlinearities are called by this letter and a number.
ARGUMENT = "s"
#: What stands before the name of a state for its derivative; no name of a model has a space.
_RATE = "rate of "
#: Exponents of powers that numbers are taken out of.
TAKEN_OUT_OF_POWERS = (*range(-8, 0), *range(2, 9))


@dataclass(frozen=True)
class LinearCombination:
    """``sum parts[name] name`` of states, faults and inputs, with exact coefficients."""

    parts: tuple[tuple[str, Fraction], ...]

    @property
    def text(self) -> str:
        """The combination as an expression."""
        words = []
        for place, (name, factor) in enumerate(self.parts):
            size = name if abs(factor) == 1 else f"{exact_number(abs(factor))} * {name}"
            sign = "-" if factor < 0 else "+" if place else ""
            words += [sign, size] if place else [f"{sign}{size}"]
        return " ".join(words)

    def over(self, names: Sequence[str]) -> FloatArray:
        """Return the coefficients of names in order ``(n,)``."""
        known = dict(self.parts)
        return np.array([float(known.get(name, Fraction(0))) for name in names])


@dataclass(frozen=True)
class Nonlinearity:
    """A function of some of the arguments, by their numbers; its names are ``s0``, ``s1``, ..."""

    expression: Expression
    arguments: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class NonlinearTerms:
    """A plant in the form above; ``n`` counts states and faults, ``nd`` of which are differential."""

    names: tuple[str, ...]  # of z: differential states, faults, algebraic states
    differential: int
    faults: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    A: FloatArray  # (n, n)
    B: FloatArray  # (n, nu)
    c: FloatArray  # (n,)
    W: FloatArray  # (n, K)
    C: FloatArray  # (ny, n)
    c_y: FloatArray  # (ny,)
    Wy: FloatArray  # (ny, K)
    arguments: tuple[LinearCombination, ...]
    nonlinearities: tuple[Nonlinearity, ...]
    equations: tuple[str, ...]  # what each row is: an equation, or combinations of several
    input_parts: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # (arguments, nu)
    state_parts: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # (arguments, n)


def nonlinear_terms(model: DAEModel, *, faults: Sequence[str] | None = None) -> NonlinearTerms:
    """Return a model in the form above.

    Parameters
    ----------
    model : DAEModel
        With its equations as texts.
    faults : sequence of str, optional
        Parameters that are estimated; all by default.  The others have their nominal values.

    Raises
    ------
    SpecError
        The equations are Python functions, or a fault is no parameter.
    PreconditionError
        What stands beside a derivative changes with the state, derivatives are dependent (index 2 or more), or a text
        chooses between formulas.

    Examples
    --------
    >>> tank = DAEModel(
    ...     {"balance": "2.0 * der(level) = inflow - 0.5 * sqrt(level) - leak"}, {"seen": "level"},
    ...     states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.0},
    ... )
    >>> found = nonlinear_terms(tank)
    >>> found.names, found.A.tolist(), found.W.tolist(), found.nonlinearities[0].expression.text
    (('level', 'leak'), [[0.0, -0.5], [0.0, 0.0]], [[-0.25], [0.0]], 'sqrt(s0)')
    """
    if callable(model.equations) or callable(model.outputs):
        raise SpecError(
            "The equations are Python functions: an observer over a region is proved from texts. Write them as texts.",
            path="equations",
        )
    chosen = tuple(model.parameter_names if faults is None else faults)
    for name in chosen:
        index_of(name, model.parameter_names, what="faults")
    known: dict[str, Any] = {name: _Form.number(value) for name, value in NAMED_NUMBERS.items()}
    known |= {name: _Form.number(value) for name, value in model.constants.items()}
    known |= {name: _Form.number(value) for name, value in model.parameters.items() if name not in chosen}
    known |= {name: _Form.variable(name) for name in (*model.state_names, *model.input_names, *chosen)}
    registry = _Registry()
    for name, text in model.definitions.items():
        known[name] = registry.form(parse_expression(text), known, f"definitions.{name}")
    rows = []
    for name, text in model.equations.items():
        expression = equation_of(text, f"equations.{name}")
        rates = {key: _rate(inner, known, registry, model, name) for key, inner in expression.rates.items()}
        rows.append(registry.form(expression, {**known, **rates}, f"equations.{name}"))
    outputs = [registry.form(parse_expression(text), known, f"outputs.{name}") for name, text in model.outputs.items()]
    return _assembled(model, chosen, registry, rows, outputs)


def linear_combination(text: str, known: Sequence[str], path: str) -> tuple[LinearCombination, Fraction, Fraction]:
    """Return an expression as ``unit * combination + constant``, with a combination that begins with one whole signal.

    Raises
    ------
    SpecError
        A name is unknown, or the expression is not linear.
    """
    registry, names = _Registry(), {name: _Form.variable(name) for name in known}
    numbers = {name: _Form.number(value) for name, value in NAMED_NUMBERS.items()}
    form = registry.form(parse_expression(text), {**numbers, **names}, path)
    if form.terms or not form.linear:
        raise SpecError(f"{text!r} is no linear combination of {', '.join(known)}: give one.", path=path)
    key, unit = _normalised(form.linear)
    return LinearCombination(key), unit, form.constant


def _normalised(linear: Mapping[str, Fraction]) -> tuple[tuple[tuple[str, Fraction], ...], Fraction]:
    """Return a combination in units of its first coefficient, and that."""
    ordered = sorted(linear.items())
    unit = ordered[0][1]
    return tuple((name, factor / unit) for name, factor in ordered), unit


@dataclass
class _Form:
    """``constant + sum linear[name] name + sum terms[text] f``, exactly."""

    constant: Fraction = Fraction(0)
    linear: dict[str, Fraction] = field(default_factory=dict)
    terms: dict[str, Fraction] = field(default_factory=dict)

    @classmethod
    def number(cls, value: Any) -> _Form:
        return cls(Fraction(float(value)))

    @classmethod
    def variable(cls, name: str) -> _Form:
        return cls(linear={name: Fraction(1)})

    @property
    def is_constant(self) -> bool:
        return not self.linear and not self.terms

    def plus(self, other: _Form, sign: int) -> _Form:
        def joined(one: dict[str, Fraction], two: dict[str, Fraction]) -> dict[str, Fraction]:
            total = dict(one)
            for name, factor in two.items():
                total[name] = total.get(name, Fraction(0)) + sign * factor
            return {name: factor for name, factor in total.items() if factor}

        return _Form(
            self.constant + sign * other.constant, joined(self.linear, other.linear), joined(self.terms, other.terms)
        )

    def times(self, factor: Fraction) -> _Form:
        if not factor:
            return _Form()
        return _Form(
            self.constant * factor,
            {name: value * factor for name, value in self.linear.items()},
            {name: value * factor for name, value in self.terms.items()},
        )


class _Registry:
    """The arguments and the nonlinearities that texts have in common."""

    def __init__(self) -> None:
        self.arguments: dict[tuple[tuple[str, Fraction], ...], int] = {}
        self.path = ""

    def form(self, expression: Expression, known: Mapping[str, Any], path: str) -> _Form:
        """Return an expression as a form."""
        self.path = path
        unknown = sorted(expression.names - set(known))
        if unknown:
            names = (name for name in known if name not in NAMED_NUMBERS)
            raise SpecError(
                f"{path}: {expression.text!r} names {unknown[0]!r}; {there_are(unknown[0], names)}", path=path
            )
        translated = expression.translated(known, self._operation)
        return translated if isinstance(translated, _Form) else _Form.number(translated)

    def _operation(self, operation: Callable[..., Any]) -> Callable[..., Any]:
        def done(*operands: Any) -> _Form:
            forms = [part if isinstance(part, _Form) else _Form.number(part) for part in operands]
            simple = self._linear(operation, forms)
            if simple is not None:
                return simple
            if all(form.is_constant for form in forms):
                with np.errstate(all="ignore"):
                    return _Form.number(operation(*(float(form.constant) for form in forms)))
            if operation not in TEXTS_OF_OPERATIONS:
                raise PreconditionError(
                    f"{self.path} chooses between formulas (a comparison, where or step), which may jump: that has no "
                    "slope. Give a smooth formula; abs, min and max are allowed.",
                    condition="jump",
                )
            factor, plain = _without_numbers(operation, forms)
            return _Form(terms={TEXTS_OF_OPERATIONS[operation](*map(self._text, plain)): factor})

        return done

    def _linear(self, operation: Callable[..., Any], forms: list[_Form]) -> _Form | None:
        """Return what is linear in the arguments of an operation; ``None`` for a nonlinearity."""
        if operation is np.negative:
            return forms[0].times(Fraction(-1))
        if operation in (np.add, np.subtract):
            return forms[0].plus(forms[1], 1 if operation is np.add else -1)
        if operation is np.multiply and any(form.is_constant for form in forms):
            fixed, moving = sorted(forms, key=lambda form: not form.is_constant)
            return moving.times(fixed.constant)
        if operation is np.divide and forms[1].is_constant and forms[1].constant:
            return forms[0].times(1 / forms[1].constant)
        if operation is np.power and forms[1].is_constant and forms[1].constant in (0, 1):
            return forms[0] if forms[1].constant else _Form(Fraction(1))
        return None

    def _text(self, form: _Form) -> str:
        """Return a form as an expression of arguments."""
        parts = []
        if form.linear:
            if any(name.startswith(_RATE) for name in form.linear):
                raise PreconditionError(
                    f"{self.path} has a derivative inside a nonlinearity: E would change with the state, and a proof "
                    "at the vertices says nothing of what is between them. Solve the equation for the derivative.",
                    condition="constant E",
                )
            key, unit = _normalised(form.linear)
            number = self.arguments.setdefault(key, len(self.arguments))
            name = f"{ARGUMENT}{number}"
            parts.append(name if unit == 1 else f"{exact_number(unit)} * {name}")
        parts += [
            text if factor == 1 else f"{exact_number(factor)} * ({text})" for text, factor in sorted(form.terms.items())
        ]
        if form.constant or not parts:
            parts.append(exact_number(form.constant))
        return parts[0] if len(parts) == 1 and _is_factor(parts[0]) else f"({' + '.join(parts)})"


def _without_numbers(operation: Callable[..., Any], forms: list[_Form]) -> tuple[Fraction, list[_Form]]:
    """Return the number that can be taken out of a product, a quotient or a power, and what is left: multiples of one
    nonlinearity are one, with one slope."""
    if operation in (np.multiply, np.divide):
        (one, x), (other, y) = map(_split, forms)
        return (one * other if operation is np.multiply else one / other), [x, y]
    if operation is np.power and forms[1].is_constant and forms[1].constant in TAKEN_OUT_OF_POWERS:
        factor, base = _split(forms[0])
        return factor ** int(forms[1].constant), [base, forms[1]]
    return Fraction(1), forms


def _split(form: _Form) -> tuple[Fraction, _Form]:
    """Return a form as a number, and what it is a multiple of: a signal, a combination in units of its first
    coefficient, or one nonlinearity."""
    if form.is_constant:
        return (form.constant, _Form(Fraction(1))) if form.constant else (Fraction(1), form)
    if form.constant or (form.linear and form.terms) or len(form.terms) > 1:
        return Fraction(1), form
    unit = _normalised(form.linear)[1] if form.linear else next(iter(form.terms.values()))
    return unit, form.times(1 / unit)


def _is_factor(text: str) -> bool:
    return text.isidentifier() or text.replace(".", "", 1).isdigit()


def exact_number(value: Fraction) -> str:
    """Return a rational number as a text that is it, where two doubles can write it."""
    number = float(value)
    if Fraction(number) == value:
        return repr(number) if number >= 0.0 else f"(-{abs(number)!r})"
    above, below = float(abs(value.numerator)), float(value.denominator)
    whole = Fraction(above) == abs(value.numerator) and Fraction(below) == value.denominator
    text = f"{above!r} / {below!r}" if whole else repr(abs(number))
    return f"({text})" if value >= 0 else f"(-({text}))"


def _rate(inner: Expression, known: Mapping[str, Any], registry: _Registry, model: DAEModel, equation: str) -> _Form:
    """Return the derivative of something linear in the states."""
    form = registry.form(inner, known, f"equations.{equation}")
    if form.terms:
        raise PreconditionError(
            f"The equation {equation!r} has der({inner.text}), which is not linear in the states: E would change with "
            "the state, and a proof at the vertices says nothing of what is between them. Take what is stored as a "
            "state, or write its derivative out and solve for that of the state.",
            condition="constant E",
        )
    others = [name for name in form.linear if name not in model.state_names]
    if others:
        raise PreconditionError(
            f"The equation {equation!r} differentiates {others[0]!r}, which is no state: write it without.",
            condition="constant E",
        )
    return _Form(linear={f"{_RATE}{name}": factor for name, factor in form.linear.items()})


def _assembled(
    model: DAEModel, faults: tuple[str, ...], registry: _Registry, rows: list[_Form], seen: list[_Form]
) -> NonlinearTerms:
    moving = [name for name in model.state_names if any(f"{_RATE}{name}" in row.linear for row in rows)]
    rates = [[row.linear.pop(f"{_RATE}{name}", Fraction(0)) for name in moving] for row in rows]
    solved, origins = _solved_for_rates(model, moving, rates, rows)
    still = [name for name in model.state_names if name not in moving]
    names = (*moving, *faults, *still)
    texts = sorted({text for form in (*solved, *seen) for text in form.terms}, key=_in_order(solved, seen))
    placed = [*solved[: len(moving)], *(_Form() for _ in faults), *solved[len(moving) :]]
    # Differential rows say z' = ..., which is minus the rest of the equation; algebraic ones are taken alike.
    placed = [form.times(Fraction(-1)) for form in placed]

    def matrix(forms: Sequence[_Form], columns: Sequence[str], kind: str) -> FloatArray:
        entries = np.array([[float(getattr(form, kind).get(name, Fraction(0))) for name in columns] for form in forms])
        return entries.reshape(len(forms), len(columns))

    def constants(forms: Sequence[_Form]) -> FloatArray:
        return np.array([float(form.constant) for form in forms])

    arguments = tuple(LinearCombination(key) for key in registry.arguments)
    nonlinearities = []
    for text in texts:
        expression = parse_expression(text)
        used = tuple(sorted(int(name[len(ARGUMENT) :]) for name in expression.names))
        nonlinearities.append(Nonlinearity(expression, used))
    return NonlinearTerms(
        names=names,
        differential=len(moving) + len(faults),
        faults=faults,
        input_names=model.input_names,
        output_names=model.output_names,
        A=matrix(placed, names, "linear"),
        B=matrix(placed, model.input_names, "linear"),
        c=constants(placed),
        W=matrix(placed, texts, "terms"),
        C=matrix(seen, names, "linear"),
        c_y=constants(seen),
        Wy=matrix(seen, texts, "terms"),
        arguments=arguments,
        nonlinearities=tuple(nonlinearities),
        equations=(*origins[: len(moving)], *(f"der({name}) = 0" for name in faults), *origins[len(moving) :]),
        input_parts=np.array([each.over(model.input_names) for each in arguments]).reshape(len(arguments), model.nu),
        state_parts=np.array([each.over(names) for each in arguments]).reshape(len(arguments), len(names)),
    )


def _in_order(solved: Sequence[_Form], seen: Sequence[_Form]) -> Callable[[str], int]:
    """Return the order in which nonlinearities occur."""
    order: dict[str, int] = {}
    for form in (*solved, *seen):
        for text in form.terms:
            order.setdefault(text, len(order))
    return order.__getitem__


def _solved_for_rates(
    model: DAEModel, moving: Sequence[str], rates: list[list[Fraction]], rows: list[_Form]
) -> tuple[list[_Form], list[str]]:
    """Return the equations with one derivative each first, then those without; by exact elimination."""
    waiting = [(list(row), form, name) for row, form, name in zip(rates, rows, model.equation_names, strict=True)]
    done: list[tuple[list[Fraction], _Form, str]] = []
    for column, state in enumerate(moving):
        # The equation with the fewest derivatives keeps its name.
        able = [i for i, (row, _, _) in enumerate(waiting) if row[column]]
        if not able:
            raise PreconditionError(
                f"The derivatives of {quoted_names(moving)} are dependent: the one of {state!r} follows from the "
                "others (index 2 or more, or a redundant state). Leave the state out, or differentiate its constraint.",
                condition="index",
                signals=(state,),
            )
        place = min(able, key=lambda i: sum(bool(value) for value in waiting[i][0]))
        row, form, name = waiting.pop(place)
        inverse = 1 / row[column]
        row, form = [value * inverse for value in row], form.times(inverse)
        waiting = [_reduced(each, row, form, column) for each in waiting]
        done = [_reduced(each, row, form, column) for each in done]
        done.append((row, form, name))
    return [form for _, form, _ in (*done, *waiting)], [name for _, _, name in (*done, *waiting)]


def _reduced(
    entry: tuple[list[Fraction], _Form, str], row: list[Fraction], form: _Form, column: int
) -> tuple[list[Fraction], _Form, str]:
    """Return an equation without one derivative."""
    own, other, name = entry
    factor = own[column]
    if not factor:
        return entry
    return [a - factor * b for a, b in zip(own, row, strict=True)], other.plus(form.times(factor), -1), name
