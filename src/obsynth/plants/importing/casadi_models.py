"""Plants from CasADi: a Function or a dictionary of expressions, as its integrators take them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from obsynth.errors import SpecError, counted
from obsynth.numerics.arguments import arguments_checked, shown
from obsynth.numerics.libraries import imported
from obsynth.numerics.suggestions import there_are
from obsynth.plants.dae import DAEModel
from obsynth.plants.importing.python_objects import INTEGRATOR_INPUTS, OUTPUTS


@arguments_checked
def from_casadi(
    system: Any,
    *,
    states: Mapping[str, float],
    inputs: Mapping[str, float] | None = None,
    parameters: Mapping[str, float] | None = None,
    output_names: Any = None,
    units: Mapping[str, str] | None = None,
) -> DAEModel:
    """Return the nonlinear plant of a CasADi Function, or of a dictionary of expressions.

    Parameters
    ----------
    system : casadi.Function or dict
        ``x' = ode(x, z, u, p)``, ``0 = alg(x, z, u, p)``, ``y = y(x, z, p)``: a Function with inputs and outputs of
        these names, or a dictionary of SX or MX with these keys, as ``casadi.integrator`` takes it.  ``z``, ``u``,
        ``p`` and ``alg`` may be missing.
    states : mapping of str to float
        Name -> nominal value, of x first and then of z.
    inputs : mapping of str to float, optional
        Name -> nominal value, of u.
    parameters : mapping of str to float, optional
        Name -> nominal value, of p.
    output_names : list of str, optional
        Names of y; ``y1, ...`` by default.
    units : mapping of str to str, optional
        As for `DAEModel`.

    Returns
    -------
    DAEModel
        Linearise it by `obsynth.linearise` for a method that needs a linear plant.

    Raises
    ------
    SpecError
        CasADi is not installed, a name is unknown, sizes do not fit, ``ode`` or ``y`` is missing, or y depends on u.

    References
    ----------
    .. [Andersson2019] J. Andersson et al., CasADi: a software framework for nonlinear optimization and optimal control,
       Math. Prog. Comp. 11 (1), 2019.

    Examples
    --------
    >>> import obsynth
    >>> import casadi
    >>> x, p = casadi.SX.sym("x"), casadi.SX.sym("p")
    >>> system = {"x": x, "p": p, "ode": -p * x, "y": x}
    >>> model = obsynth.from_casadi(system, states={"x": 1.0}, parameters={"p": 0.5})
    >>> model.nx, model.parameter_names
    (1, ('p',))
    """
    casadi = imported("casadi", extra="nonlinear", what="A plant of CasADi")
    function = _function(casadi, system)
    taken = {name: function.size1_in(name) if name in function.name_in() else 0 for name in INTEGRATOR_INPUTS}
    made = {name: function.size1_out(name) if name in function.name_out() else 0 for name in OUTPUTS}
    nx, nz = taken["x"], taken["z"]
    for what, count, wanted in (
        ("states", len(states), nx + nz),
        ("inputs", len(inputs or {}), taken["u"]),
        ("parameters", len(parameters or {}), taken["p"]),
    ):
        if count != wanted:
            raise SpecError(f"{what} names {counted(count, 'value')}, but the system has {wanted}.", path=what)
    if made["ode"] != nx or made["alg"] != nz or not made["y"]:
        raise SpecError(
            f"The system has {counted(nx, 'state')} x and {counted(nz, 'state')} z, but "
            f"{counted(made['ode'], 'equation')} ode, {made['alg']} alg and {counted(made['y'], 'output')} y: one ode "
            "for each x, one alg for each z, and at least one y are needed.",
            path="system",
        )
    if "u" in function.name_in() and function.jac_sparsity(function.index_out("y"), function.index_in("u")).nnz():
        raise SpecError("y depends on u: outputs are of states and parameters alone.", path="system")

    def values(x: Any, u: Any, theta: Any) -> dict[str, Any]:
        columns = {"x": x[:nx], "z": x[nx:], "u": u, "p": theta}
        return dict(function(**{name: casadi.vertcat(*columns[name]) for name in function.name_in()}))

    def equations(rates: Any, x: Any, u: Any, theta: Any) -> list[Any]:
        parts = values(x, u, theta)
        moving = [rates[i] - parts["ode"][i] for i in range(nx)]
        return moving + [parts["alg"][i] for i in range(nz)]

    def outputs(x: Any, theta: Any) -> list[Any]:
        y = values(x, [0.0] * taken["u"], theta)["y"]
        return [y[i] for i in range(made["y"])]

    output_names = [f"y{i + 1}" for i in range(made["y"])] if output_names is None else output_names
    return DAEModel(
        equations, outputs, states=states, inputs=inputs, parameters=parameters, units=units, output_names=output_names
    )


def _function(casadi: Any, system: Any) -> Any:
    """Return a Function with our names; raise `SpecError` for what is none."""
    if isinstance(system, Mapping):
        unknown = [key for key in system if key not in (*INTEGRATOR_INPUTS, *OUTPUTS)]
        if unknown:
            raise SpecError(
                f"system has the unknown key {unknown[0]!r}; {there_are(unknown[0], (*INTEGRATOR_INPUTS, *OUTPUTS))}",
                path="system",
            )
        names = [name for name in INTEGRATOR_INPUTS if name in system]
        results = [name for name in OUTPUTS if name in system]
        try:
            made = casadi.Function("plant", [system[n] for n in names], [system[n] for n in results], names, results)
        except (RuntimeError, NotImplementedError, TypeError) as error:
            raise SpecError(f"CasADi makes no function of this system: {error}", path="system") from error
        return made
    if not isinstance(system, casadi.Function):
        raise SpecError(f"system is {shown(system)}: give a casadi.Function, or a dictionary.", path="system")
    unknown = [name for name in (*system.name_in(), *system.name_out()) if name not in (*INTEGRATOR_INPUTS, *OUTPUTS)]
    if unknown:
        raise SpecError(
            f"The Function has an input or output {unknown[0]!r}: name them {', '.join(INTEGRATOR_INPUTS)} and "
            f"{', '.join(OUTPUTS)}.",
            path="system",
        )
    return system
