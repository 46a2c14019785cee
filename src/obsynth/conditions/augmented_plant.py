"""The plant behind an unknown-input PI observer: faults as states, unknown inputs removed; and its realisation.

Share Pasand, Aliyari, Taghirad, (4), (10)-(13), (19), (20), with Df and Dd, and without the Moore-Penrose ``E#``, with
which U loses rank.  With ``xa = [x; w]``, ``z+ = Ahat z + Jhat u + Bhat y``, ``xahat = z + D_a y`` is unbiased if

    U_a Ea + D_a Ca = I,   D_a Dd = 0,   U_a Bda = K_a Dd,   Ahat = U_a Aa - K_a Ca,   Bhat = Ahat D_a + K_a.

Outputs that show d directly are solved for it: ``d1 = Dd^+ (y - C x - Df f)`` is put into the equations of the states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.existence.augmented_pencils import AugmentedPlant
from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank, numerical_rank, product_but_rounding
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.plant_units import PlantUnits


@dataclass(frozen=True, eq=False)
class Decoupled:
    """A solution of ``U E + Dhat C = I``, ``Dhat Dd = 0``; with any Z so are ``U + Z free_U``, ``Dhat + Z free_D``."""

    U: FloatArray  # (nx, nx)
    Dhat: FloatArray  # (nx, ny)
    free_U: FloatArray  # (n_free, nx)
    free_D: FloatArray  # (n_free, ny)
    undisturbed: FloatArray  # (ny2, ny), orthonormal rows: outputs that no disturbance reaches directly
    injection: FloatArray  # (nx, ny): the part Bd Dd^+ of the equations that is fed with y


def direct_part(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the outputs without direct disturbance, ``Bd Dd^+``, and a basis of the disturbances left."""
    if not plant.Dd.any():
        return np.eye(plant.ny), np.zeros((plant.nx, plant.ny)), _range_basis(plant.Bd)
    left_vectors, values, right_vectors = np.linalg.svd(plant.Dd)
    rank = numerical_rank(values)
    inverse = right_vectors[:rank].T @ (left_vectors[:, :rank] / values[:rank]).T
    return left_vectors[:, rank:].T, plant.Bd @ inverse, _range_basis(plant.Bd @ right_vectors[rank:].T)


def _range_basis(matrix: FloatArray) -> FloatArray:
    if matrix.shape[1] == 0 or not matrix.any():
        return np.zeros((matrix.shape[0], 0))
    lengths = np.linalg.norm(matrix, axis=0)
    left_vectors, values, _ = np.linalg.svd(matrix / np.where(lengths > 0.0, lengths, 1.0), full_matrices=False)
    return np.asarray(left_vectors[:, : numerical_rank(values)])


def decouple(plant: DescriptorSystem) -> Decoupled:
    r"""Return U and Dhat with ``U E + Dhat C = I``, ``U Bd2 = 0`` and ``ker U = im Bd2``; (D1) must hold.

    With the annihilator Bp of Bd2 and ``Q = [Bp E; C2]``: ``[Ut Dt] = Q^+ + Z N``, N a basis of the left null space of
    Q, and Z such that Ut has full column rank: the polar factor of what makes ``[Ut; N_U]`` orthogonal.
    """
    undisturbed, injection, remaining = direct_part(plant)
    nx, left_over = plant.nx, plant.nx - remaining.shape[1]
    annihilator = np.linalg.svd(remaining)[0][:, remaining.shape[1] :].T if remaining.shape[1] else np.eye(nx)
    stacked = np.vstack([annihilator @ plant.E, undisturbed @ plant.C])
    q, r = np.linalg.qr(stacked, mode="complete")
    inverse = np.linalg.solve(r[:nx], q[:, :nx].T)
    inverse = inverse + (np.eye(nx) - inverse @ stacked) @ inverse
    null = q[:, nx:].T
    ut, dt = inverse[:, :left_over], inverse[:, left_over:]
    nu, nd = null[:, :left_over], null[:, left_over:]
    # What A leaves open a fixed matrix decides, and not the orientation of somebody's singular vectors.
    generic = np.random.default_rng(0).standard_normal((nx, nx))
    # Where no equation has a derivative, ut is the rounding of the whole inverse.
    size = largest_singular_value(inverse) if inverse.size else 0.0
    z = _rank_completion(ut, nu, plant.A.T @ annihilator.T, generic @ annihilator.T, size)
    return Decoupled(
        (ut + z @ nu) @ annihilator,
        (dt + z @ nd) @ undisturbed,
        nu @ annihilator,
        nd @ undisturbed,
        undisturbed,
        injection,
    )


def _rank_completion(
    ut: FloatArray, nu: FloatArray, target: FloatArray, generic: FloatArray, size: float
) -> FloatArray:
    """Return Z such that ``ut + Z nu`` has full column rank; ``[ut; nu]`` has, so what ut lacks, nu sees.

    Kernel directions of ut go outside its range, near where ``target`` sends them, or else ``generic``: no choice hangs
    on rounding.  ``size``: of what ut is a part of.
    """
    rows, columns = ut.shape
    if columns == 0 or nu.shape[0] == 0:
        return np.zeros((rows, nu.shape[0]))
    left_vectors, values, right_vectors = np.linalg.svd(ut)
    rank = numerical_rank(values, scale=size)
    largest = float(values[0]) if rank else 1.0
    lacking = columns - rank
    if lacking == 0:
        return np.zeros((rows, nu.shape[0]))
    kernel = right_vectors[rank:].T
    free = left_vectors[:, rank:]
    scale = float(np.linalg.norm(target))
    outside = free @ _nearest_isometry(free.T @ target @ kernel, free.T @ generic @ kernel, scale)
    image = nu @ kernel
    return np.asarray(outside @ np.linalg.pinv(image) * largest)


def _nearest_isometry(matrix: FloatArray, otherwise: FloatArray, scale: float) -> FloatArray:
    """Return the matrix ``(m, n)``, ``m >= n``, with orthonormal columns that is nearest: the polar factor.
    Directions in which the matrix is nothing beside ``scale`` go where ``otherwise (m, n)`` sends them."""
    left_vectors, values, right_vectors = np.linalg.svd(matrix)
    rank = numerical_rank(values, scale=scale)
    isometry = left_vectors[:, :rank] @ right_vectors[:rank]
    if rank < matrix.shape[1]:
        outer, inner = left_vectors[:, rank:], right_vectors[rank:]
        turned = np.linalg.svd(outer.T @ otherwise @ inner.T, full_matrices=False)
        isometry = isometry + outer @ turned[0] @ turned[2] @ inner
    return np.asarray(isometry)


def paper_decoupling(
    plant: DescriptorSystem, *, e_sharp: FloatArray, c_sharp: FloatArray, g: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return L, U and Dhat, (10), (11), for ``e_sharp (nx, nx)``, ``c_sharp (nx, ny)`` and ``g (nx, ny)``."""
    nx, ny = plant.nx, plant.ny
    shapes = {"E_sharp": (e_sharp, (nx, nx)), "C_sharp": (c_sharp, (nx, ny)), "G": (g, (nx, ny))}
    for name, (matrix, shape) in shapes.items():
        require_shape(matrix.shape, shape, name)
    if plant.Dd.any():
        raise SpecError("E_sharp, C_sharp and G are for plants without Dd: leave them out.", path="E_sharp")
    miss = np.abs(e_sharp @ plant.E + c_sharp @ plant.C - np.eye(nx))
    size = np.abs(e_sharp) @ np.abs(plant.E) + np.abs(c_sharp) @ np.abs(plant.C) + np.eye(nx)
    if np.max(miss) > RANK_TOLERANCE * np.max(size):
        raise SpecError(f"E_sharp E + C_sharp C misses the identity by {np.max(miss):.3g}.", path="E_sharp")
    output_effect = plant.C @ e_sharp @ plant.Bd
    # Judged against its factors, not against its own norm: it may be nothing but rounding.
    norms = [largest_singular_value(part) for part in (plant.C, e_sharp, plant.Bd)] if plant.nd else [1.0]
    rank = decide_rank(output_effect, expected=plant.nd, scale=float(np.prod(norms)), equilibrated=False)
    if not rank.full:
        raise SpecError(
            f"With this E_sharp, C E# Bd has {rank.describe()}: choose another E_sharp, or leave it out.",
            path="E_sharp",
        )
    remaining = np.eye(nx) - g @ plant.C
    if not decide_rank(remaining, expected=nx, equilibrated=False).full:
        raise SpecError("I - G C is singular, which adds an unobservable mode: choose another G.", path="G")
    inverse: FloatArray = np.zeros((0, ny))
    if plant.nd:
        # By normal equations, so that simple numbers stay exact; one refinement makes up for their condition.
        inverse = np.asarray(np.linalg.solve(output_effect.T @ output_effect, output_effect.T), dtype=np.float64)
        inverse = inverse + (np.eye(plant.nd) - inverse @ output_effect) @ inverse
    basis = e_sharp @ plant.Bd @ inverse
    correction = basis + g @ (np.eye(ny) - plant.C @ basis)
    u = remaining @ (np.eye(nx) - basis @ plant.C) @ e_sharp
    return correction, u, c_sharp + correction @ (np.eye(ny) - plant.C @ c_sharp)


def realise(
    plant: DescriptorSystem, model: Exosystem, gains: tuple[FloatArray, FloatArray, FloatArray], undisturbed: FloatArray
) -> tuple[LinearObserver, dict[str, FloatArray]]:
    """Return the observer with gains ``U (na, na)``, ``D (na, ny)`` and ``K (na, ny)`` of the augmented plant, and its
    matrices by the paper's letters; ``undisturbed (nr, ny)``."""
    u, d, k = gains
    augmented = AugmentedPlant.of(plant, model)
    nx, na = plant.nx, augmented.order
    a_hat = u @ augmented.A - k @ augmented.C
    # Rows that follow nothing, or show nothing, are zero: rounding would be all that their identities are judged by.
    b_hat = product_but_rounding(a_hat, d, k)
    j_hat = u @ augmented.B
    faults = np.hstack([np.zeros((plant.nf, nx)), model.Cw])
    rows = np.vstack([np.eye(nx, na), faults, -undisturbed @ augmented.C])
    output_part = np.vstack([np.zeros((nx + plant.nf, plant.ny)), undisturbed])
    direct = product_but_rounding(rows, d, output_part)
    names = (
        plant.output_names
        if np.array_equal(undisturbed, np.eye(plant.ny))
        else tuple(f"r{i + 1}" for i in range(len(undisturbed)))
    )
    observer = LinearObserver(
        Az=a_hat,
        Bu=j_hat - b_hat @ plant.D,
        By=b_hat,
        Cz=rows,
        Du=-direct @ plant.D,
        Dy=direct,
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=plant.state_names,
        fault_names=plant.fault_names,
        residual_names=names,
        state_delays=(0,) * nx,
        fault_delays=(0,) * plant.nf,
    )
    letters = {"U_a": u, "D_a": d, "K_a": k, "Ahat": a_hat, "Bhat": b_hat, "Jhat": j_hat}
    return observer, letters


def measured_combinations(plant: DescriptorSystem) -> FloatArray:
    """Return the combinations of outputs that no disturbance reaches directly, each of unit length."""
    if not plant.Dd.any():
        return np.eye(plant.ny)
    units = PlantUnits.of(plant)
    undisturbed = direct_part(units.scaled_plant(plant))[0] * units.outputs
    return np.asarray(undisturbed / np.linalg.norm(undisturbed, axis=1, keepdims=True))


def with_faults(
    u: FloatArray, d: FloatArray, plant: DescriptorSystem, model: Exosystem
) -> tuple[FloatArray, FloatArray]:
    """Return ``U_a = [U, -Dhat Df Cw; 0, I]`` and ``D_a = [Dhat; 0]``: the faults are never read from y directly."""
    nx, count = plant.nx, model.order
    u_a = np.eye(nx + count)
    u_a[:nx, :nx], u_a[:nx, nx:] = u, -d @ plant.Df @ model.Cw
    return u_a, np.vstack([d, np.zeros((count, plant.ny))])
