r"""Polytopic (linear parameter-varying) descriptor systems: plants whose matrices change with measured parameters.

.. math::
    E x^+ = A(\mu) x + B(\mu) u + B_d(\mu) d + B_f(\mu) f + B_w(\mu) w, \qquad
    y = C(\mu) x + D(\mu) u + D_d(\mu) d + D_f(\mu) f + D_w(\mu) w

Every matrix is a weighted mean of its values at the vertices.  The weights :math:`\mu(\rho)`, on the simplex, follow
from the scheduling parameters :math:`\rho`, which are measured at the same sample as y.  E is the same at all vertices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError, a_kind
from obsynth.numerics.arguments import is_finite_number, require_mapping, shown
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.convex_hulls import spanning_points
from obsynth.numerics.expressions import NAMED_NUMBERS, parse_expression
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.other_names import plant_keywords_suggested
from obsynth.plants.scheduled_inputs import require_measured, with_inputs_scheduled
from obsynth.plants.scheduling import LinearForm, Scheduling, linear_form, parameters_of, range_of_function
from obsynth.plants.uncertainty import expressions_in

#: Matrices that may change over a region.
SCHEDULED_MATRICES = ("A", "B", "C", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw")
#: Properties that all vertices of a plant have to share.
_SHARED = ("dt", "state_names", "input_names", "output_names", "fault_names", "disturbance_names", "noise_names")


class PolytopicSystem:
    r"""A linear descriptor system whose matrices change with measured scheduling parameters.

    Parameters
    ----------
    vertices : sequence of DescriptorSystem, optional
        One or more plants (or their `as_dict`) with the same E, sample time and signal names.  Without ``scheduling``
        the weights of the vertices are the scheduling parameters, named ``weight1, weight2, ...``.
    plant : mapping, optional
        The arguments of `DescriptorSystem`, in place of ``vertices``.  Entries of all matrices but E may be expressions
        of the scheduling parameters, such as ``"-k / m"``.
    scheduling : mapping, optional
        For ``plant``: ``{name: {"range": [low, high], "rate": ..., "column": ..., "unit": ...}}`` or
        ``{name: [low, high]}``.  ``rate`` is the largest change per second, and ``column`` the column of a log with
        the parameter, if it has another name.  For two ``vertices``: one parameter with its range; the first vertex
        belongs to the low end.
    constants : mapping of str to float, optional
        Values of the other names in the expressions.
    shift : str, optional
        A known input that is one in every row, as in plants of `linearise`: logs have no column for it.

    Raises
    ------
    SpecError
        Vertices that differ in E, sample time or names; an empty range; a rate that is not positive; an expression
        with an unknown name; E with an expression; more than 12 functions of the parameters in the matrices.
    PreconditionError
        An expression is not bounded over the region, or may jump there.

    Notes
    -----
    A known input of ``plant`` may schedule it: what B and D have of it is then a column of an input that is one in
    every row (``shift``).

    Entries may be any functions of the parameters.  Each nonlinear function, such as ``v ** 2`` beside ``v``, becomes a
    dimension of the polytope, with proved bounds.  The polytope then contains more plants than the parameters allow,
    and a proof for the polytope holds for all of these.  Entries are rounded to double precision once.

    References
    ----------
    .. [Hamdi2012] H. Hamdi, M. Rodrigues, C. Mechmeche, D. Theilliol, N. BenHadj Braiek, Fault detection and isolation
       in linear parameter-varying descriptor systems via proportional integral observer, Int. J. Adapt. Control Signal
       Process. 26 (3), 2012.

    Examples
    --------
    >>> spring = PolytopicSystem(
    ...     plant={"A": [[0, 1], ["-k", -1]], "C": [[1, 0]], "Bd": [[0], [1]], "state_names": ["x", "v"]},
    ...     scheduling={"k": [1.0, 6.0]},
    ... )
    >>> spring
    <PolytopicSystem: 2 vertices over k in [1, 6]; nx 2, ny 1, nu 0, nf 0, nd 1, continuous>
    >>> spring.at({"k": 2.0}).A.tolist()
    [[0.0, 1.0], [-2.0, -1.0]]
    """

    vertices: tuple[DescriptorSystem, ...]
    scheduling: Scheduling
    shift: str | None

    @plant_keywords_suggested
    def __init__(
        self,
        vertices: Sequence[DescriptorSystem] | None = None,
        *,
        plant: Mapping[str, Any] | None = None,
        scheduling: Mapping[str, Any] | None = None,
        constants: Mapping[str, float] | None = None,
        shift: str | None = None,
    ) -> None:
        if (vertices is None) == (plant is None):
            raise SpecError("Give vertices, or plant with expressions and scheduling.", path="vertices")
        arguments: dict[str, Any]
        own_shift = shift
        if vertices is not None:
            if constants:
                raise SpecError("constants are for plant, whose entries may be expressions.", path="constants")
            dense_vertices, held = _from_vertices(vertices, scheduling)
            arguments = {"vertices": [vertex.as_dict() for vertex in dense_vertices], "scheduling": _plain(scheduling)}
        else:
            require_mapping(plant, "plant")
            numbers = _constants(constants)
            dense_vertices, held, own_shift = _from_expressions(plant or {}, scheduling, numbers, shift)
            arguments = {"plant": _plain(plant), "scheduling": _plain(scheduling), "constants": numbers}
        if own_shift is not None and own_shift not in dense_vertices[0].input_names:
            raise SpecError(f"shift is {shown(shift)}, which is no input of the plant.", path="shift")
        arguments |= {} if shift is None else {"shift": shift}
        shift = own_shift
        for name, value in (
            ("vertices", dense_vertices),
            ("scheduling", held),
            ("shift", shift),
            ("_given", arguments),
        ):
            object.__setattr__(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"a PolytopicSystem cannot be changed: {name}")

    def __getattr__(self, name: str) -> Any:
        # The plant has the properties that its vertices share: names, sizes, sample time, E.
        if name.startswith("_") or "vertices" not in vars(self):
            raise AttributeError(name)
        first = self.vertices[0]
        if name in _SHARED or name in ("E", "units", "scales", "operating_point"):
            return getattr(first, name)
        if name in ("nx", "nu", "ny", "nf", "nd", "nw", "is_discrete"):
            return getattr(first, name)
        raise AttributeError(f"a PolytopicSystem has no {name!r}; its vertices may have.")

    @property
    def count(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    def is_constant(self, *names: str) -> bool:
        """Whether the matrices with these names are the same at all vertices.

        Parameters
        ----------
        *names : str
            Names of matrices, such as ``"C"``.
        """
        first = self.vertices[0]
        return all(
            np.array_equal(getattr(vertex, name), getattr(first, name)) for vertex in self.vertices for name in names
        )

    def weights(self, parameters: Mapping[str, float] | Sequence[float]) -> FloatArray:
        """Return the weights of the vertices ``(N,)`` at scheduling parameters.

        Parameters
        ----------
        parameters : mapping or sequence
            Values by name, or in order; inside the region.

        Raises
        ------
        SpecError
            A parameter is missing, unknown or outside the region.
        """
        values = self.scheduling.values(parameters)
        if not self.scheduling.is_inside(values):
            point = ", ".join(
                f"{name} = {value:.6g}" for name, value in zip(self.scheduling.names, values, strict=True)
            )
            raise SpecError(f"{point} is outside the region: {self.scheduling.sentence()}.", path="scheduling")
        return self.scheduling.weights(values)

    def at(self, parameters: Mapping[str, float] | Sequence[float]) -> DescriptorSystem:
        """Return the time-invariant plant at constant scheduling parameters.

        Parameters
        ----------
        parameters : mapping or sequence
            Values by name, or in order; inside the region.

        Raises
        ------
        SpecError
            A parameter is missing, unknown or outside the region.
        """
        return self.mean(self.weights(parameters))

    def mean(self, weights: FloatArray) -> DescriptorSystem:
        """Return the time-invariant plant at given weights of the vertices.

        Parameters
        ----------
        weights : FloatArray
            Weights ``(N,)`` on the simplex.
        """
        changed = {}
        for name in SCHEDULED_MATRICES:
            if not self.is_constant(name):
                changed[name] = sum(w * getattr(v, name) for w, v in zip(weights, self.vertices, strict=True))
        return self.vertices[0].replace(exact=None, **changed) if changed else self.vertices[0]

    @cached_property
    def center(self) -> DescriptorSystem:
        """The mean of the extreme points of the polytope: vertices that repeat or lie between others do not count."""
        spanning = spanning_points(
            [np.concatenate([getattr(each, name).ravel() for name in SCHEDULED_MATRICES]) for each in self.vertices]
        )
        used = range(self.count) if spanning is None else spanning[0]
        weights = np.zeros(self.count)
        weights[list(used)] = 1.0 / len(used)
        return self.mean(weights)

    def as_dict(self) -> dict[str, Any]:
        """Return the arguments of the constructor that made this plant."""
        return dict(self._given)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PolytopicSystem:
        """Return the plant that `as_dict` described.

        Parameters
        ----------
        data : mapping
            The arguments of the constructor by name.
        """
        return cls(**data)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).from_dict, (self.as_dict(),)

    def __repr__(self) -> str:
        """Return sizes and region in one line."""
        time = f"dt {self.dt:g}" if self.dt else "continuous"
        sizes = ", ".join(f"{name} {getattr(self, name)}" for name in ("nx", "ny", "nu", "nf", "nd"))
        return f"<PolytopicSystem: {self.count} vertices over {self.scheduling.sentence()}; {sizes}, {time}>"


def _from_vertices(
    vertices: Sequence[DescriptorSystem], scheduling: Mapping[str, Any] | None
) -> tuple[tuple[DescriptorSystem, ...], Scheduling]:
    """Return checked vertices, and their scheduling: one stated parameter, or the weights as parameters."""
    if isinstance(vertices, Sequence):
        vertices = [DescriptorSystem(**vertex) if isinstance(vertex, Mapping) else vertex for vertex in vertices]
    if isinstance(vertices, Sequence) and not vertices:
        raise SpecError("vertices are empty: give one DescriptorSystem or more.", path="vertices")
    if isinstance(vertices, DescriptorSystem) or not isinstance(vertices, Sequence):
        raise SpecError(f"vertices are {a_kind(vertices)}: give a list of DescriptorSystem.", path="vertices")
    for place, vertex in enumerate(vertices):
        if not isinstance(vertex, DescriptorSystem):
            raise SpecError(f"Vertex {place + 1} is {a_kind(vertex)}: give a DescriptorSystem.", path="vertices")
    dense = tuple(vertex.dense() for vertex in vertices)
    first = dense[0]
    for place, vertex in enumerate(dense[1:], start=2):
        if vertex.uncertainty is not None or first.uncertainty is not None:
            raise SpecError(
                "A vertex has constants with tolerances, which no proof over a region takes in yet: leave them out "
                "(plant.replace(uncertainty=None)).",
                path="vertices",
            )
        for name in _SHARED:
            if getattr(vertex, name) != getattr(first, name):
                raise SpecError(f"Vertex {place} has another {name} than vertex 1.", path=f"vertices.{name}")
        for name in SCHEDULED_MATRICES:
            if getattr(vertex, name).shape != getattr(first, name).shape:
                raise SpecError(f"{name} of vertex {place} has another shape than that of vertex 1.", path="vertices")
        if not np.array_equal(vertex.E, first.E):
            raise PreconditionError(
                f"E of vertex {place} is not that of vertex 1: with a matrix E(mu) beside the next state a proof at "
                "the vertices says nothing of what is between them. Solve the equations that have the parameter "
                "beside a derivative for that derivative.",
                condition="constant E",
            )
    if scheduling is None:
        count = len(dense)
        names = tuple(f"weight{i + 1}" for i in range(count))
        return dense, Scheduling(names, np.zeros(count), np.ones(count), (None,) * count, ())
    parameters = parameters_of(scheduling)
    if len(dense) != 2 or len(parameters) != 1:
        raise SpecError(
            "scheduling beside vertices is one parameter of two vertices; the parameters of more are their weights "
            "(leave scheduling out), or give plant with expressions.",
            path="scheduling",
        )
    require_measured(parameters, {name: getattr(first, name) for name in _SHARED if name.endswith("_names")})
    ((name, entry),) = parameters.items()
    if (entry.get("column") or name) in first.input_names:
        raise SpecError(
            f"{name!r} is a known input: two vertices do not tell what it does by itself. Give plant with expressions, "
            "which may have it in A and as an input.",
            path=f"scheduling.{name}",
        )
    return dense, _scheduling(parameters, tuple(parameters))


def _scheduling(parameters: Mapping[str, Mapping[str, Any]], functions: Sequence[str]) -> Scheduling:
    return Scheduling(
        tuple(parameters),
        np.array([entry["range"][0] for entry in parameters.values()]),
        np.array([entry["range"][1] for entry in parameters.values()]),
        tuple(entry.get("rate") for entry in parameters.values()),
        tuple(functions),
        {name: str(entry["column"]) for name, entry in parameters.items() if entry.get("column")},
        {name: str(entry["unit"]) for name, entry in parameters.items() if entry.get("unit")},
    )


def _constants(values: Mapping[str, float] | None) -> dict[str, float]:
    constants = dict(values or {})
    for name, value in constants.items():
        if not is_finite_number(value):
            raise SpecError(f"The constant {name!r} is {shown(value)}: give a finite number.", path=f"constants.{name}")
    return {str(name): float(value) for name, value in constants.items()}


def _from_expressions(
    plant_arguments: Mapping[str, Any],
    scheduling: Mapping[str, Any] | None,
    constants: Mapping[str, float],
    shift: str | None,
) -> tuple[tuple[DescriptorSystem, ...], Scheduling, str | None]:
    """Return the vertices of a plant whose entries are expressions, its scheduling, and the input that is one."""
    if not isinstance(plant_arguments, Mapping):
        raise SpecError(
            f"plant is {a_kind(plant_arguments)}: give the arguments of DescriptorSystem by name.", path="plant"
        )
    parameters = parameters_of(scheduling)
    both = sorted(set(parameters) & set(constants))
    if both:
        raise SpecError(f"{both[0]!r} is both a scheduling parameter and a constant.", path=f"scheduling.{both[0]}")
    arguments = dict(plant_arguments)
    if expressions_in(arguments.get("E"))[1]:
        raise PreconditionError(
            "E has an expression: with a matrix E(mu) beside the next state a proof at the vertices says nothing of "
            "what is between them. Solve the equations that have the parameter beside a derivative for that "
            "derivative.",
            condition="constant E",
        )
    written: dict[str, list[tuple[int, int, str]]] = {}
    for name in SCHEDULED_MATRICES:
        arguments[name], written[name] = expressions_in(arguments.get(name))
    arguments, written, shift = with_inputs_scheduled(arguments, written, parameters, shift)
    # Each function doubles the number of vertices.  Products of sums are expanded if that makes fewer functions and
    # keeps all parameters.
    choices = [_forms(written, constants, tuple(parameters), expanded=expanded) for expanded in (False, True)]
    forms, used = min(choices, key=lambda choice: (-len(_names_in(choice[1])), len(choice[1])))
    functions = list(dict.fromkeys([*parameters, *used]))
    idle = [name for name in parameters if name not in _names_in(used)]
    if idle:
        if idle[0] in NAMED_NUMBERS:
            text = f"{idle[0]!r} is a number in expressions: give the parameter another name."
            raise SpecError(text, path=f"scheduling.{idle[0]}")
        raise SpecError(
            f"No entry depends on {idle[0]!r}: leave it out of scheduling, or write it into an entry of the matrices.",
            path=f"scheduling.{idle[0]}",
        )
    base = _descriptor({key: value for key, value in arguments.items() if value is not None})
    require_measured(parameters, {name: getattr(base, name) for name in _SHARED if name.endswith("_names")})
    try:
        held = _scheduling(parameters, [text for text in functions if text in used])
    except PreconditionError:
        _require_bounded(forms, {name: (entry["range"][0], entry["range"][1]) for name, entry in parameters.items()})
        raise
    corners = tuple(_vertex(base, forms, dict(zip(held.functions, row, strict=True))) for row in held.corners)
    return corners, held, shift


def _require_bounded(
    forms: Mapping[str, list[tuple[int, int, LinearForm]]], box: Mapping[str, tuple[float, float]]
) -> None:
    """Raise `PreconditionError` for a function without a range over the region, with the entry it is in."""
    for matrix, entries in forms.items():
        for row, column, form in entries:
            for text in form.parts:
                try:
                    range_of_function(parse_expression(text), box)
                except PreconditionError as error:
                    names = sorted(parse_expression(text).names)
                    ranges = ", ".join(f"{name} in [{box[name][0]:.6g}, {box[name][1]:.6g}]" for name in names)
                    raise PreconditionError(
                        f"{matrix}[{row + 1},{column + 1}]: {error} Here {ranges}.", condition=error.condition
                    ) from None


def _forms(
    written: Mapping[str, list[tuple[int, int, str]]],
    constants: Mapping[str, float],
    names: tuple[str, ...],
    *,
    expanded: bool,
) -> tuple[dict[str, list[tuple[int, int, LinearForm]]], list[str]]:
    """Return the entries of matrices as linear forms in functions of the parameters, and these functions in order."""
    forms = {
        matrix: [
            (row, column, _form(text, f"{matrix}[{row + 1},{column + 1}]", constants, names, expanded=expanded))
            for row, column, text in entries
        ]
        for matrix, entries in written.items()
    }
    parts = (text for entries in forms.values() for _, _, form in entries for text in form.parts)
    return forms, list(dict.fromkeys(parts))


def _names_in(functions: Sequence[str]) -> set[str]:
    """Return the parameters that functions depend on."""
    return {name for text in functions for name in parse_expression(text).names}


def _descriptor(arguments: dict[str, Any]) -> DescriptorSystem:
    if "A" not in arguments:
        raise SpecError("plant has no matrix A.", path="plant.A")
    try:
        return DescriptorSystem(arguments.pop("E", None), arguments.pop("A"), **arguments).dense()
    except TypeError as error:
        raise SpecError(f"plant: {error}.", path="plant") from error


def _form(
    text: str, place: str, constants: Mapping[str, float], names: tuple[str, ...], *, expanded: bool
) -> LinearForm:
    try:
        expression = parse_expression(text)
    except SpecError as error:
        raise SpecError(f"{place}: {error}", path=f"plant.{place}") from None
    unknown = sorted(expression.names - set(names) - set(constants))
    if unknown:
        raise SpecError(
            f"{place} is {text!r}: {unknown[0]!r} is no scheduling parameter and no constant. Give its value in "
            "constants, or its range in scheduling.",
            path=f"plant.{place}",
        )
    try:
        return linear_form(expression, constants, names, expanded=expanded)
    except SpecError as error:
        raise SpecError(f"{place} is {text!r}: {error}", path=f"plant.{place}") from None
    except (ValueError, ArithmeticError) as error:
        raise SpecError(f"{place} is {text!r}, which has no finite value: {error}.", path=f"plant.{place}") from error


def _vertex(
    base: DescriptorSystem, forms: Mapping[str, list[tuple[int, int, LinearForm]]], values: Mapping[str, float]
) -> DescriptorSystem:
    """Return the plant at values of the functions, with every entry rounded once."""
    changed = {}
    for name, entries in forms.items():
        if not entries:
            continue
        matrix = np.array(getattr(base, name))
        for row, column, form in entries:
            total = form.constant + sum((f * Fraction(values[text]) for text, f in form.parts.items()), Fraction(0))
            try:
                matrix[row, column] = float(total)
            except OverflowError:
                where = ", ".join(f"{text} = {values[text]:.6g}" for text in form.parts)
                raise PreconditionError(
                    f"{name}[{row + 1},{column + 1}] overflows at {where}. Give a smaller range, or other units.",
                    condition="boundedness",
                ) from None
        changed[name] = matrix
    return base.replace(**changed) if changed else base


def _plain(value: Any) -> Any:
    """Return a constructor argument as nested dictionaries, lists, numbers and texts."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if hasattr(value, "toarray"):
        return value.toarray().tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    return value.item() if isinstance(value, np.generic) else value
