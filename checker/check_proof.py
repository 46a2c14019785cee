"""Check a proof file of obsynth by exact integer arithmetic, with nothing but Python's standard library.

    python -I check_proof.py proof.json

A proof file holds integers: a plant, an observer, claims about the two, and for each claim the numbers ("witnesses")
that prove it.  This program forms every inequality and identity anew from plant and observer.  Nothing is rounded and
nothing is searched for, so an accepted claim is a theorem about the numbers of the file.  Exit code 0: every claim is
proved; 1: one is not; 2: the file cannot be read.  The format is described in docs/explanation/proof_files.md.

How to read this file (about an hour): sections 1 and 2 are the arithmetic and the one lemma on positive definite
matrices; section 3 forms the error system; sections 4 and 6 have one function a claim, each with its proof in its
docstring; section 5 does so for plants that change with parameters; section 7 reads the file and prints the verdicts.

Notation: the plant is ``E x+ = A x + B u + Bf f + Bd d + Bw w``, ``y = C x + D u + Df f + Dd d + Dw w``, where x+ is
the next state or, with sample time zero, the derivative.  The observer is ``z+ = Az z + Bu u + By y``, and its rows are
``r = Cz z + Du u + Dy y``.  A' is a transpose.
"""

import json
import sys
from fractions import Fraction

FORMAT, VERSION = "obsynth-proof", 1
#: Files with larger exponents are refused: a few bytes could otherwise fill the memory.
LARGEST_EXPONENT = 100_000
#: So are larger sizes and counts, for the same reason, and more states than this with those of the lag.
LARGEST_COUNT, MOST_STATES = 100_000, 5_000
#: Kinds of rows.
ROW_KINDS = ("state", "fault", "residual")
#: The identities of an observer must hold to this share of the terms that they consist of.
LARGEST_SHARE = Fraction(1, 1000)
NOT_ITS_FAULT = "an estimate is not that of its fault"


class Refused(Exception):
    """A claim is not proved, or the file is not what it should be."""


def require(condition, reason):
    """Refuse unless a condition holds."""
    if not condition:
        raise Refused(reason)


# 1. Exact matrices --------------------------------------------------------------------------------------------------


class Matrix:
    """A matrix of numbers ``integer * 2**exponent``: sums and products of these are exact."""

    def __init__(self, rows, columns, entries, exponent=0):
        self.rows, self.columns, self.entries, self.exponent = rows, columns, entries, exponent

    @staticmethod
    def zero(rows, columns):
        """Return a matrix of zeros."""
        return Matrix(rows, columns, [[0] * columns for _ in range(rows)])

    @staticmethod
    def identity(size):
        """Return the identity."""
        return Matrix(size, size, [[int(i == j) for j in range(size)] for i in range(size)])

    @staticmethod
    def blocks(parts):
        """Return a matrix of blocks, given by rows of blocks."""
        exponent = min(part.exponent for row in parts for part in row)
        entries = []
        for row in parts:
            require(len({part.rows for part in row}) == 1, "blocks do not fit")
            aligned = [part.integers(exponent) for part in row]
            entries += [[value for part in aligned for value in part[i]] for i in range(row[0].rows)]
        columns = sum(part.columns for part in parts[0])
        require(all(len(row) == columns for row in entries), "blocks do not fit")
        return Matrix(len(entries), columns, entries, exponent)

    def integers(self, exponent):
        """Return the entries as multiples of ``2**exponent``, which must not be above the own exponent."""
        shift = self.exponent - exponent
        return [[value << shift for value in row] for row in self.entries] if shift else self.entries

    def __add__(self, other):
        require((self.rows, self.columns) == (other.rows, other.columns), "matrices of different sizes are added")
        exponent = min(self.exponent, other.exponent)
        both = zip(self.integers(exponent), other.integers(exponent), strict=True)
        entries = [[a + b for a, b in zip(one, two, strict=True)] for one, two in both]
        return Matrix(self.rows, self.columns, entries, exponent)

    def __neg__(self):
        return Matrix(self.rows, self.columns, [[-value for value in row] for row in self.entries], self.exponent)

    def __sub__(self, other):
        return self + (-other)

    def __matmul__(self, other):
        require(self.columns == other.rows, "matrices that do not fit are multiplied")
        across = list(zip(*other.entries, strict=True)) if other.rows else [()] * other.columns
        entries = []
        for row in self.entries:
            used = [k for k, value in enumerate(row) if value]
            entries.append([sum(row[k] * column[k] for k in used) for column in across])
        return Matrix(self.rows, other.columns, entries, self.exponent + other.exponent)

    @property
    def T(self):
        """The transpose."""
        entries = (
            [list(column) for column in zip(*self.entries, strict=True)]
            if self.rows
            else [[] for _ in range(self.columns)]
        )
        return Matrix(self.columns, self.rows, entries, self.exponent)

    def absolute(self):
        """Return the absolute values."""
        return Matrix(self.rows, self.columns, [[abs(v) for v in row] for row in self.entries], self.exponent)

    def times(self, number):
        """Return the product with a matrix of one entry."""
        require((number.rows, number.columns) == (1, 1), "one number is needed")
        value = number.entries[0][0]
        entries = [[value * entry for entry in row] for row in self.entries]
        return Matrix(self.rows, self.columns, entries, self.exponent + number.exponent)

    def part(self, rows=None, columns=None):
        """Return some rows and columns, given as lists of numbers; all where there is none."""
        rows = range(self.rows) if rows is None else rows
        columns = range(self.columns) if columns is None else columns
        entries = [[self.entries[i][j] for j in columns] for i in rows]
        return Matrix(len(rows), len(columns), entries, self.exponent)

    def is_zero(self):
        """Whether every entry is zero."""
        return not any(map(any, self.entries))

    def fraction(self, i, j):
        """Return one entry."""
        return Fraction(self.entries[i][j]) * Fraction(2) ** self.exponent

    def number(self):
        """Return the only entry."""
        require((self.rows, self.columns) == (1, 1), "one number is needed")
        return self.fraction(0, 0)


def shown(value, down=False):
    """Return a number for readers with four digits, rounded upwards or downwards: what is printed must hold too."""
    value = Fraction(value)
    if not value:
        return "0"
    digits = len(str(abs(value.numerator))) - len(str(value.denominator)) + 1
    while abs(value) < Fraction(10) ** (digits - 1):
        digits -= 1
    unit = Fraction(10) ** (digits - 4)
    units = value // unit if down else -((-value) // unit)
    return f"{float(units):.0f}e{digits - 4}" if abs(digits) > 290 else f"{float(units * unit):.5g}"


# 2. The lemma on positive definite matrices -------------------------------------------------------------------------


def require_positive_definite(matrix, witness, what):
    """Prove ``S > 0`` for a symmetric matrix S.

    The witness is a matrix F and positive integers d, one for each row.  With ``R = S - F'F``, which is computed
    exactly, ``x'Sx = |Fx|^2 + x'Rx``.  If ``d_i R_ii > sum of d_j |R_ij| over the other j`` in every row i, then R,
    each row and column times its d, is strictly diagonally dominant with a positive diagonal, so that ``x'Rx > 0`` for
    all x that are not zero (Gershgorin), and so is ``x'Sx``.  Any F and d will do: they need not be trusted.
    """
    size = matrix.rows
    require(matrix.columns == size and (matrix - matrix.T).is_zero(), f"{what}: the matrix is not symmetric")
    factor, weights = read_matrix(witness["factor"]), [read_integer(value) for value in witness["weights"]]
    require(factor.columns == size and len(weights) == size, f"{what}: the factor does not fit")
    require(all(weight > 0 for weight in weights), f"{what}: a weight is not positive")
    rest = (matrix - factor.T @ factor).entries
    for i, row in enumerate(rest):
        others = sum(abs(value) * weight for value, weight in zip(row, weights, strict=True)) - abs(row[i]) * weights[i]
        require(row[i] * weights[i] > others, f"{what}: the matrix is not proved to be positive definite (row {i + 1})")


# 3. The error system ------------------------------------------------------------------------------------------------


class System:
    """The plant, the observer and what its state follows: everything that claims are about.

    The observer's state z follows ``T E xa``.  Here xa is the plant's state x; with a lag it holds the last states too,
    the newest first; with a fault model ``w+ = Phi w``, ``f = Cw w`` it holds w.  ``T0``, where there is one, combines
    equations of the plant with ``T0 E = 0`` and is added to the rows.
    """

    def __init__(self, file):
        plant, observer, follows = file["plant"], file["observer"], file["follows"]
        for name in ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw"):
            setattr(self, name, read_matrix(plant[name]))
        for name in ("Az", "Bu", "By", "Cz", "Du", "Dy"):
            setattr(self, name, read_matrix(observer[name]))
        self.dt = read_matrix(plant["sample_time"]).number()
        require(self.dt >= 0, "the sample time is negative")
        self.discrete = self.dt > 0
        self.shapes()
        counts = {"states": self.E.columns, "faults": self.Bf.columns, "disturbances": self.Bd.columns}
        self.names = {kind: read_names(plant["names"][kind], count, kind) for kind, count in counts.items()}
        self.row_kinds = [
            (kind, name, read_count(delay, "a delay", most=10_000)) for kind, name, delay in observer["rows"]
        ]
        require(len(self.row_kinds) == self.Cz.rows, "each row of the observer needs a kind, a name and a delay")
        self.lag, self.decoupled = read_count(follows["lag"], "the lag", most=1000), follows["decoupled"]
        require(isinstance(self.decoupled, bool), "whether disturbances are decoupled is true or false")
        require(self.discrete or not self.lag, "a lag needs samples")
        require((self.lag + 1) * self.E.rows <= MOST_STATES, "the lag is too long")
        self.Phi, self.Cw = read_matrix(follows["Phi"]), read_matrix(follows["Cw"])
        self.T, self.T0 = read_matrix(follows["T"]), read_matrix(follows["T0"])
        self.witness, self.proved_contraction = file.get("contraction"), None
        self.extend()

    def contraction(self):
        """Return the contraction of the file, proved once."""
        if self.proved_contraction is None:
            require(self.witness is not None, "the file has no contraction")
            self.proved_contraction = Contraction(self, self.witness)
        return self.proved_contraction

    def shapes(self):
        """Refuse matrices that do not fit each other."""
        n, nu, ny, nz = self.E.rows, self.B.columns, self.C.rows, self.Az.rows
        wanted = {"E": (n, n), "A": (n, n), "B": (n, nu), "C": (ny, n), "D": (ny, nu)}
        for state, output in (("Bf", "Df"), ("Bd", "Dd"), ("Bw", "Dw")):
            count = getattr(self, state).columns
            wanted |= {state: (n, count), output: (ny, count)}
        rows = self.Cz.rows
        wanted |= {"Az": (nz, nz), "Bu": (nz, nu), "By": (nz, ny), "Cz": (rows, nz), "Du": (rows, nu), "Dy": (rows, ny)}
        for name, shape in wanted.items():
            found = getattr(self, name)
            require((found.rows, found.columns) == shape, f"{name} is {found.rows} x {found.columns}, not {shape}")

    def extend(self):
        """Form the equations of xa (``Ea, Aa, Ba, Ca, Bda``), and the goal: row i should equal row i of ``goal xa``."""
        n, past, count = self.E.rows, self.lag * self.E.rows, self.Phi.rows
        require(self.Phi.columns == self.Cw.columns == count, "Phi and Cw do not fit")
        require(not count or self.Cw.rows == self.Bf.columns, "Cw does not have a row for each fault")
        zero, one = Matrix.zero, Matrix.identity
        cw = self.Cw if count else zero(self.Bf.columns, 0)
        shift = Matrix.blocks([[one(past), zero(past, n)]])
        self.Ea = diagonal(self.E, one(past), one(count))
        first = Matrix.blocks([[self.A, zero(n, past)]])
        moved = Matrix.blocks([[first], [shift]])
        into = Matrix.blocks([[self.Bf @ cw], [zero(past, count)]])
        self.Aa = Matrix.blocks([[moved, into], [zero(count, n + past), self.Phi]])
        self.Ba = Matrix.blocks([[self.B], [zero(past + count, self.B.columns)]])
        self.Bda = Matrix.blocks([[self.Bd], [zero(past + count, self.Bd.columns)]])
        self.Ca = Matrix.blocks([[self.C, zero(self.C.rows, past), self.Df @ cw]])
        total = n + past + count
        require((self.T.rows, self.T.columns) == (self.Az.rows, total), "T does not fit")
        require((self.T0.rows, self.T0.columns) == (self.Cz.rows, total), "T0 does not fit")
        goal = zero(self.Cz.rows, total)
        for i, (kind, name, delay) in enumerate(self.row_kinds):
            require(kind in ROW_KINDS and isinstance(name, str), f"row {i + 1} is of an unknown kind")
            if kind == "state":
                require(delay == self.lag, "the delay of a state is not the lag")
                goal.entries[i][past + self.index("states", name)] = 1
            if kind == "fault" and count:
                fault = self.index("faults", name)
                row = cw.part([fault])
                for j in range(count):
                    require(delay == 0 or not row.entries[0][j], "a fault model with a delay is not followed by T")
                goal = goal + Matrix.blocks(
                    [[zero(i, total)], [Matrix.blocks([[zero(1, n + past), row]])], [zero(goal.rows - i - 1, total)]]
                )
        self.goal = goal

    def index(self, kind, name):
        """Return the number of a signal."""
        require(name in self.names[kind], f"{name!r} is none of the {kind}")
        return self.names[kind].index(name)

    def rows_of(self, kinds):
        """Return the numbers of the rows of the observer that are of some kinds."""
        require(isinstance(kinds, list) and set(kinds) <= set(ROW_KINDS), "there are no such rows")
        return [i for i, (kind, _, _) in enumerate(self.row_kinds) if kind in kinds]

    def rows_of_each(self, kinds):
        """Return the same, and refuse kinds without rows: a sentence names them all."""
        rows = self.rows_of(kinds)
        require(kinds and {self.row_kinds[i][0] for i in rows} == set(kinds), "there are no such rows")
        return rows

    def identities(self):
        """Return what must vanish, and the sum of the absolute values of its terms, by name.

        With ``eps = z - T Ea xa``, the equations of plant and observer give, without faults, noise and (unless they are
        decoupled) disturbances::

            eps+ = Az eps + K xa + U u + V d,      K = Az T Ea + By Ca - T Aa,   U = Bu + By D - T Ba,
            r - goal xa = Cz eps + J xa + L u + W d,   J = Cz T Ea + Dy Ca + T0 Aa - goal,   L = Du + Dy D + T0 Ba,

        and ``V = By Dd - T Bda``, ``W = Dy Dd + T0 Bda``; for J, L and W, ``T0 (Aa xa + Ba u + Bda d) = T0 Ea xa+ = 0``
        was added, and so ``Z = T0 Ea`` must vanish too.  What is stored was rounded: these are small, not zero.
        """
        te = self.T @ self.Ea
        terms = {
            "K": [self.Az @ te, self.By @ self.Ca, -(self.T @ self.Aa)],
            "U": [self.Bu, self.By @ self.D, -(self.T @ self.Ba)],
            "J": [self.Cz @ te, self.Dy @ self.Ca, self.T0 @ self.Aa, -self.goal],
            "L": [self.Du, self.Dy @ self.D, self.T0 @ self.Ba],
        }
        sizes = {
            "K": [
                self.Az.absolute() @ (self.T.absolute() @ self.Ea.absolute()),
                product(self.By, self.Ca),
                product(self.T, self.Aa),
            ],
            "U": [self.Bu.absolute(), product(self.By, self.D), product(self.T, self.Ba)],
            "J": [
                self.Cz.absolute() @ (self.T.absolute() @ self.Ea.absolute()),
                product(self.Dy, self.Ca),
                product(self.T0, self.Aa),
                self.goal.absolute(),
            ],
            "L": [self.Du.absolute(), product(self.Dy, self.D), product(self.T0, self.Ba)],
        }
        terms["Z"], sizes["Z"] = [self.T0 @ self.Ea], [product(self.T0, self.Ea)]
        if self.decoupled:
            terms |= {"V": [self.By @ self.Dd, -(self.T @ self.Bda)], "W": [self.Dy @ self.Dd, self.T0 @ self.Bda]}
            sizes |= {
                "V": [product(self.By, self.Dd), product(self.T, self.Bda)],
                "W": [product(self.Dy, self.Dd), product(self.T0, self.Bda)],
            }
        return {name: (total(terms[name]), total(sizes[name])) for name in terms}

    def driven(self, signal):
        """Return B and D with ``e+ = Az e + B s``, ``r - goal xa = -Cz e + D s`` for a signal s; e is ``T Ea xa - z``.

        ``fault model``: s is added to w+, so that the fault may have any course.
        """
        if signal == "fault model":
            columns = list(range(self.T.columns - self.Phi.rows, self.T.columns))
            return self.T.part(None, columns), self.T0.part(None, columns)
        both = Matrix.blocks([[self.Bd, self.Bw]]), Matrix.blocks([[self.Dd, self.Dw]])
        known = {
            "faults": (self.Bf, self.Df),
            "disturbances": (self.Bd, self.Dd),
            "noise": (self.Bw, self.Dw),
            "disturbances and noise": both,
        }
        require(signal in known, f"{signal!r} is no signal")
        b, d = known[signal]
        own = list(range(self.E.rows))
        return (self.T.part(None, own) @ b - self.By @ d, self.Dy @ d + self.T0.part(None, own) @ b)


def diagonal(*parts):
    """Return the blocks of a diagonal."""
    rows = [
        [part if i == j else Matrix.zero(part.rows, other.columns) for j, other in enumerate(parts)]
        for i, part in enumerate(parts)
    ]
    return Matrix.blocks(rows)


def product(one, two):
    """Return the product of the absolute values."""
    return one.absolute() @ two.absolute()


def total(parts):
    """Return the sum of some matrices."""
    found = parts[0]
    for part in parts[1:]:
        found = found + part
    return found


# 4. Claims on the error system --------------------------------------------------------------------------------------
# Each takes the system and a claim, refuses what is not proved, and returns the sentence that is proved.


def identities_hold(system, claim):
    """Without faults the observer follows what it should, but for rounding of its stored numbers.

    Each entry of what the identities miss (see ``System.identities``) is at most ``share`` times the sum of the
    absolute values of its terms, or ``share`` times the largest such sum of its column where this is far larger
    (``floor`` times it: what is nothing but rounding of large terms is compared with these). What
    disturbances do to an observer that is decoupled from them (V, W) is bounded in ``rounding``.
    """
    share, floor = read_matrix(claim["share"]).number(), read_matrix(claim["floor"]).number()
    require(0 <= share <= LARGEST_SHARE and 0 <= floor <= 1, "the identities are allowed to miss too much")
    for name, (missed, sizes) in system.identities().items():
        if name in ("K", "U", "J", "L"):
            require_small(missed, sizes, share, floor, f"identity {name}")
    return (
        f"without faults, z follows T E x, and the rows what they stand for, to {shown(share)} of all terms"
        f"{shown_floor(share, floor)}"
    )


def shown_floor(share, floor):
    """Return what small entries are compared with, in words."""
    return f", or to {shown(share * floor)} of the largest of their column" if floor else ""


def lyapunov(system, claim, rate, a):
    """Prove ``P > 0`` and ``a'Pa < rate^2 P`` or, in continuous time, ``a'P + Pa + 2 rate P < 0``; return P.

    Then ``V(e) = e'Pe`` decreases faster than ``rate^(2k)`` or ``exp(-2 rate t)`` along ``e+ = a e``.
    """
    p = read_matrix(claim["P"])
    require_positive_definite(p, claim["P_positive"], "P")
    if system.discrete:
        left = p.times(rate).times(rate) - a.T @ p @ a
    else:
        half = a.T @ p + p.times(rate)
        left = -(half + half.T)
    require_positive_definite(left, claim["decreases"], "the Lyapunov inequality")
    return p


class Contraction:
    """A bound on what a column k of inputs does to a row c of outputs, where ``eps+ = Az eps + k s``, ``|s| <= 1``.

    P and a rate are as in ``lyapunov``: from zero, the norm ``|eps|_P`` stays below ``|k|_P / (1 - rate)`` or, in
    continuous time, ``|k|_P / rate``.  G with ``[P, I; I, G] > 0`` is above the inverse of P, so that
    ``|c eps|^2 <= c G c' |eps|_P^2`` (Cauchy-Schwarz).
    """

    def __init__(self, system, witness):
        rate = read_matrix(witness["rate"])
        value, one = rate.number(), Matrix.identity(system.Az.rows)
        require(0 < value < 1 if system.discrete else value > 0, "the rate is none of decay")
        self.p, self.g = lyapunov(system, witness, rate, system.Az), read_matrix(witness["G"])
        require_positive_definite(Matrix.blocks([[self.p, one], [one, self.g]]), witness["G_covers"], "G")
        self.slowness = 1 - value if system.discrete else value
        rows = [system.Cz.part([i]) for i in range(system.Cz.rows)]
        self.heights = [(c @ self.g @ c.T).number() for c in rows]

    def require_bounds(self, bounds, columns, own, what):
        """Refuse unless each entry of ``bounds`` is at least ``own``, and what ``columns`` add to it."""
        require((bounds.rows, bounds.columns) == (own.rows, own.columns), f"the bounds for {what} do not fit")
        for j in range(own.columns):
            column = columns.part(None, [j])
            length = (column.T @ self.p @ column).number()
            for i in range(own.rows):
                left = bounds.fraction(i, j) - own.fraction(i, j)
                require(
                    left >= 0 and (left * self.slowness) ** 2 >= self.heights[i] * length,
                    f"the bound of row {i + 1} and column {j + 1} for {what} is not proved",
                )


def stable(system, claim):
    """Errors decay: a Lyapunov inequality with a rate below one or, in continuous time, not below zero."""
    rate = read_matrix(claim["rate"])
    value = rate.number()
    require(0 < value < 1 if system.discrete else value >= 0, "the rate is none of decay")
    lyapunov(system, claim, rate, system.Az)
    if system.discrete:
        return f"every mode of Az decays, faster than (1 - {shown(1 - value, down=True)})^k"
    return f"every mode of Az decays, faster than exp(-{shown(value, down=True)} t)" if value else "every mode decays"


def gain_is_below(system, claim):
    """The l2 gain from a signal to the errors of some rows is below gamma, and these errors decay: bounded real lemma.

    For ``e+ = a e + b s``, ``r = c e + d s``, ``V = e'Pe`` with P > 0: if ``|r|^2 - gamma^2 |s|^2 + V(e+) - V(e) < 0``
    for all e, s that are not zero, sums over time give ``sum |r|^2 < gamma^2 sum |s|^2`` from e = 0.  In continuous
    time the derivative of V is in the place of ``V(e+) - V(e)``.  With s = 0 it is a Lyapunov inequality.  States after
    the first ``states`` ones are left out where neither those nor the rows depend on them.
    """
    gamma, first = read_matrix(claim["gamma"]), read_count(claim["states"], "the states", most=system.Az.rows)
    rows, core = system.rows_of_each(claim["rows"]), list(range(first))
    beyond = list(range(first, system.Az.rows))
    require(system.Az.part(core, beyond).is_zero() and system.Cz.part(rows, beyond).is_zero(), "states were left out")
    b, d = system.driven(claim["signal"])
    a, b, c, d = system.Az.part(core, core), b.part(core), -system.Cz.part(rows, core), d.part(rows)
    require_bounded_real(system, claim, a, b, c, d)
    return (
        f"the l2 gain from the {claim['signal']} to the error of the {' and '.join(claim['rows'])} rows is below "
        f"{shown(gamma.number())}"
    )


def require_bounded_real(system, claim, a, b, c, d):
    """Prove the bounded real inequality (see ``gain_is_below``) of a system for the gamma and the P of a claim."""
    p = read_matrix(claim["P"])
    require(p.rows == a.rows, "P does not fit")
    require_positive_definite(p, claim["P_positive"], "P")
    whole = bounded_real(system.discrete, read_matrix(claim["gamma"]), p, p, a, b, c, d)
    require_positive_definite(whole, claim["bounded_real"], "the bounded real inequality")


def bounded_real(discrete, gamma, p, after, a, b, c, d):
    """Return the matrix of ``V(e) - V(e+) - |r|^2 + gamma^2 |s|^2``, V of P now and, in discrete time, of P after."""
    require(gamma.number() > 0, "gamma is not positive")
    level = Matrix.identity(b.columns).times(gamma).times(gamma) - d.T @ d
    if discrete:
        corner, side = p - a.T @ after @ a - c.T @ c, -(a.T @ after @ b + c.T @ d)
        level = level - b.T @ after @ b
    else:
        corner, side = -(a.T @ p + p @ a + c.T @ c), -(p @ b + c.T @ d)
    return Matrix.blocks([[corner, side], [side.T, level]])


class Model:
    """A linear model ``x+ = A x + B s``, ``C x + D s`` (a reference or a weight), all states of which count."""

    def __init__(self, a, b, c, d):
        n, shapes = a.rows, [(part.rows, part.columns) for part in (a, b, c, d)]
        require(shapes == [(n, n), (n, d.columns), (d.rows, n), (d.rows, d.columns)], "a model does not fit")
        self.A, self.B, self.C, self.D = a, b, c, d

    @staticmethod
    def read(given):
        """Read a model of the file."""
        return Model(*(read_matrix(given[name]) for name in "ABCD"))

    def behind(self, first):
        """Return the model of this one behind another."""
        require(first.D.rows == self.D.columns, "models that do not fit are put in series")
        return Model(
            Matrix.blocks([[first.A, Matrix.zero(first.A.rows, self.A.rows)], [self.B @ first.C, self.A]]),
            Matrix.blocks([[first.B], [self.B @ first.D]]),
            Matrix.blocks([[self.D @ first.C, self.C]]),
            self.D @ first.D,
        )


def matching_is_close(system, claim):
    """The l2 gain from faults, disturbances and noise, each behind its weight, to a weighted error is below gamma.

    The error of some rows is ``r``, or ``r - M f`` where the faults count: M is a stable reference model of what the
    rows should be of the faults f.  From rest ``e+ = Az e + B s``, ``r = -Cz e + D s`` (see ``System.driven``), beside
    the states of M, behind the weight of the signals s and before that of the errors; then as in ``gain_is_below``.
    The bounded real inequality contains a Lyapunov inequality: reference and weights are stable where it holds.
    """
    require(not system.Phi.rows, "the observer follows a fault model: its rows are no estimates from rest")
    rows, with_faults, with_noise = system.rows_of_each(claim["rows"]), claim["faults"], claim["noise"]
    require(isinstance(with_faults, bool) and isinstance(with_noise, bool), "whether signals count is true or false")
    counted = [system.index("disturbances", name) for name in claim["disturbances"]]
    require(len(set(counted)) == len(counted), "a disturbance counts twice")
    parts = [system.driven("faults")] * with_faults
    parts += [tuple(part.part(None, counted) for part in system.driven("disturbances"))]
    parts += [system.driven("noise")] * with_noise
    b, d = (Matrix.blocks([list(each)]) for each in zip(*parts, strict=True))
    error = Model(system.Az, b, -system.Cz.part(rows), d.part(rows))
    require((claim["reference"] is not None) == with_faults, "faults count from a reference model, and it with faults")
    if with_faults:
        reference, others = Model.read(claim["reference"]), b.columns - system.Bf.columns
        shape = (reference.D.rows, reference.D.columns)
        require(shape == (len(rows), system.Bf.columns), "the reference model does not fit")
        error = Model(
            diagonal(error.A, reference.A),
            Matrix.blocks([[error.B], [Matrix.blocks([[reference.B, Matrix.zero(reference.A.rows, others)]])]]),
            Matrix.blocks([[error.C, -reference.C]]),
            error.D - Matrix.blocks([[reference.D, Matrix.zero(len(rows), others)]]),
        )
    weights = claim["input_weight"], claim["error_weight"]
    if weights[0] is not None:
        error = error.behind(Model.read(weights[0]))
    if weights[1] is not None:
        error = Model.read(weights[1]).behind(error)
    require(error.D.columns, "no signal counts")
    require_bounded_real(system, claim, error.A, error.B, error.C, error.D)
    signals = ["the faults"] * with_faults + claim["disturbances"] + ["the noise"] * with_noise
    listed = " and ".join(signals) + (", behind the weights of this file," if weights[0] is not None else "")
    error = "weighted error" if weights[1] is not None else "error"
    goal = " from the reference model of this file" if with_faults else ""
    return (
        f"the l2 gain from {listed} to the {error} of the {' and '.join(claim['rows'])} rows{goal} is below "
        f"{shown(read_matrix(claim['gamma']).number())}"
    )


def deviation_is_below(system, claim):
    """Under white noise of unit variance (density) each row's error has at most a standard deviation (H2 norm).

    If ``X >= a X a' + b b'`` or, in continuous time, ``a X + X a' + b b' <= 0``, X is above the covariance of e in the
    steady state, and ``c X c' + d d'`` above that of the row: e depends on earlier noise alone.
    """
    a, (b, d) = system.Az, system.driven("noise")
    x, bounds = read_matrix(claim["X"]), read_matrix(claim["deviations"])
    require_positive_definite(x, claim["X_positive"], "X")
    moved = a @ x
    rest = x - moved @ a.T - b @ b.T if system.discrete else -(moved + moved.T) - b @ b.T
    require_positive_definite(rest, claim["covers"], "the covariance inequality")
    rows = system.rows_of_each(claim["rows"])
    require((bounds.rows, bounds.columns) == (len(rows), 1), "there is not a bound for each row")
    for place, i in enumerate(rows):
        c, through = system.Cz.part([i]), d.part([i])
        require(system.discrete or through.is_zero(), "white noise of infinite variance reaches a row")
        variance = (c @ x @ c.T + through @ through.T).number() if system.discrete else (c @ x @ c.T).number()
        bound = bounds.fraction(place, 0)
        require(bound >= 0 and variance <= bound**2, f"the deviation of row {i + 1} is not proved")
    listed = ", ".join(shown(bounds.fraction(k, 0)) for k in range(len(rows)))
    return f"white noise as modelled makes errors of at most these standard deviations: {listed}"


def rounding_adds_little(system, claim):
    """What rounding of the stored numbers adds to each row, per unit of each state, known input (and disturbance).

    eps, the distance of z from what it follows, is driven by columns of K, U and V (see ``System.identities``), and the
    row's own part, J, L or W, is added.  A fault's estimate must be within a thousandth of the fault of a fault model.
    """
    contraction, found, worst = system.contraction(), system.identities(), Fraction(0)
    own = {seen: found[seen][0].absolute() for seen in ("J", "L", "W") if seen in found}
    # The next state keeps the bounds of the state; its rate has none.
    require(system.discrete or found["Z"][0].is_zero(), "T0 E is not zero, and rates have no bounds")
    own["J"] = own["J"] + found["Z"][0].absolute()
    pairs = {"states": ("K", "J"), "inputs": ("U", "L")} | ({"disturbances": ("V", "W")} if system.decoupled else {})
    require(set(claim["bounds"]) == set(pairs), "there are not bounds for each kind of signal")
    for kind, (moved, seen) in pairs.items():
        bounds = read_matrix(claim["bounds"][kind])
        contraction.require_bounds(bounds, found[moved][0], own[seen], kind)
        worst = max([worst, *entries_of(bounds)]) if kind != "disturbances" else worst
        if kind == "states":
            require_faults_are_seen(system, bounds)
    besides = ""
    if system.decoupled and system.Bd.columns:
        most = max(entries_of(read_matrix(claim["bounds"]["disturbances"])), default=0)
        besides = f"; disturbances, whatever their course, add at most {shown(most)} per unit"
    return f"rounding adds at most {shown(worst)} to any row, per unit of any state or input{besides}"


def require_faults_are_seen(system, bounds):
    """Refuse bounds per unit of a state by which an estimate could be another one than that of its fault's model."""
    for i in system.rows_of(["fault"]):
        for j in range(system.T.columns - system.Phi.rows, bounds.columns):
            size = abs(system.goal.fraction(i, j))
            require(not size or bounds.fraction(i, j) <= LARGEST_SHARE * size, NOT_ITS_FAULT)


def faults_are_estimated(system, claim):
    """A fault of any course shows in its own estimate, after its delay, and in no other row, but for rounding.

    For sampled filters.  A fault impulse leaves ``a^(k-1) b`` in e; row i responds to it with ``d`` at once and with
    ``-c a^(k-1) b`` after k samples.  That should be one where row i is named like the fault and k is its delay, and
    zero elsewhere.  ``bounds`` are at least the sum of all differences: those up to the largest delay, each, and by the
    contraction those after it, which start with the column ``a^delay b``.
    """
    require(system.discrete, "the claim is for sampled filters")
    contraction, bounds, (b, d) = system.contraction(), read_matrix(claim["bounds"]), system.driven("faults")
    delays = {name: delay for kind, name, delay in system.row_kinds if kind == "fault"}
    require(set(delays) == set(system.names["faults"]), "not every fault is estimated")
    require(len(delays) == len(system.rows_of(["fault"])), "a fault has two estimates")
    require(min(delays.values()) >= 1, "a fault is estimated without delay")
    missed, trace = d.absolute(), b
    for step in range(1, max(delays.values()) + 1):
        wanted = Matrix.zero(d.rows, d.columns)
        for i, (kind, name, _) in enumerate(system.row_kinds):
            if kind in ("fault", "residual") and delays.get(name) == step:
                wanted.entries[i][system.index("faults", name)] = 1
        missed = missed + (system.Cz @ trace + wanted).absolute()
        trace = system.Az @ trace
    contraction.require_bounds(bounds, trace, missed, "faults")
    for i in system.rows_of(["fault"]):
        own = bounds.fraction(i, system.index("faults", system.row_kinds[i][1]))
        require(own <= LARGEST_SHARE, NOT_ITS_FAULT)
    listed = ", ".join(f"{name} {delay}" for name, delay in delays.items())
    return (
        f"each fault is estimated as it was so many samples ago ({listed}), and shows nowhere else, to "
        f"{shown(max(entries_of(bounds)))} per unit of it"
    )


def fault_models_are_followed(system, claim):
    """Faults that follow their models ``w+ = Phi w``, ``f = Cw w`` are estimated as they are, but for rounding.

    If ``Az Pi + (By Df - T Bf) Cw = Pi Phi``, then ``z - T E x = Pi w`` is a motion of the filter, to which all others
    decay.  There row i is ``(Cz Pi + (Dy Df + T0 Bf) Cw) w``: the mean of the fault over ``mean`` samples, of which the
    newest is ``delay`` samples old, or zero for residuals (both sides are multiplied by a power of Phi).  ``bounds``
    are of the errors for model states w within one at all times: what the equation of Pi misses drives a difference.
    """
    phi, cw, pi = (read_matrix(claim[name]) for name in ("Phi", "Cw", "Pi"))
    delay, mean = (read_count(claim[name], f"the {name}", most=10_000) for name in ("delay", "mean"))
    bounds, estimates = read_matrix(claim["bounds"]), system.rows_of(["fault"])
    require(mean >= 1, "a mean is of one sample at least")
    require(phi.rows == phi.columns == cw.columns and cw.rows == system.Bf.columns, "Phi and Cw do not fit")
    require(estimates, "no fault is estimated")
    for i in estimates:
        own = cw.part([system.index("faults", system.row_kinds[i][1])])
        require(not own.is_zero(), f"{system.row_kinds[i][1]} has no model")
    require(system.discrete or (delay == 0 and mean == 1), "a delay needs samples")
    b, d = system.driven("faults")
    drives = system.Az @ pi - b @ cw - pi @ phi
    powers = [Matrix.identity(phi.rows)]
    for _ in range(delay + mean - 1):
        powers.append(powers[-1] @ phi)
    seen, many = (system.Cz @ pi + d @ cw) @ powers[-1], Matrix(1, 1, [[mean]])
    wanted = []
    for kind, name, _ in system.row_kinds:
        row = cw.part([system.index("faults", name)]) if kind == "fault" else Matrix.zero(1, phi.rows)
        wanted.append([total([row @ powers[mean - 1 - j] for j in range(mean)])])
    wanted = Matrix.blocks(wanted)
    system.contraction().require_bounds(
        bounds.times(many), drives.times(many), (seen.times(many) - wanted).absolute(), "fault models"
    )
    for i in system.rows_of(["fault"]):
        for j in range(phi.rows):
            size = abs(wanted.fraction(i, j)) / mean
            require(not size or bounds.fraction(i, j) <= LARGEST_SHARE * size, NOT_ITS_FAULT)
    after = f", {delay} samples late" if delay else ""
    still = (phi - Matrix.identity(phi.rows) if system.discrete else phi).is_zero()
    return (
        f"faults that {'are constant' if still else 'follow w+ = Phi w'} are estimated as they are{after}, to "
        f"{shown(max(entries_of(bounds), default=0))} per unit of a model's state"
    )


def entries_of(matrix):
    """Return all entries."""
    return [matrix.fraction(i, j) for i in range(matrix.rows) for j in range(matrix.columns)]


def plant_follows(system, claim):
    """The plant's equations follow from those as written: algebraic states are eliminated, and nothing else.

    Written: ``E0 x0+ = A0 x0 + B0 s``, ``y = C0 x0 + D0 s`` with s all signals.  For M and N with ``N E0 = 0``, the
    state ``x = X x0`` with ``X = M E0`` obeys ``x+ = M A0 x0 + M B0 s``, and adding ``N (A0 x0 + B0 s) = 0`` changes no
    output.  So if ``M A0 = A X``, ``M B0 = B``, ``C0 + N A0 = C X``, ``D0 + N B0 = D``, every motion of the plant as
    written is one of the plant with E = I.  Each holds to ``share`` of its terms, or of the largest of its column times
    ``floor``.
    """
    written = {name: read_matrix(value) for name, value in claim["written"].items()}
    m, n = read_matrix(claim["M"]), read_matrix(claim["N"])
    share, floor = read_matrix(claim["share"]).number(), read_matrix(claim["floor"]).number()
    require(0 <= share <= LARGEST_SHARE and 0 <= floor <= 1, "the equations are allowed to miss too much")
    require((system.E - Matrix.identity(system.E.rows)).is_zero(), "the plant without algebraic states needs E = I")
    together = {
        name: Matrix.blocks([[written[part] for part in parts]])
        for name, parts in (("B0", ("B", "Bf", "Bd", "Bw")), ("D0", ("D", "Df", "Dd", "Dw")))
    }
    b = Matrix.blocks([[system.B, system.Bf, system.Bd, system.Bw]])
    d = Matrix.blocks([[system.D, system.Df, system.Dd, system.Dw]])
    e0, a0, c0, x = written["E"], written["A"], written["C"], m @ written["E"]
    require((n @ e0).is_zero(), "N E0 is not zero")
    for parts in (
        [m @ a0, -(system.A @ x)],
        [m @ together["B0"], -b],
        [c0, n @ a0, -(system.C @ x)],
        [together["D0"], n @ together["B0"], -d],
    ):
        sizes = total([part.absolute() for part in parts])
        require_small(total(parts), sizes, share, floor, "the equations as written")
    return (
        f"the plant is the one as written without its algebraic states, to {shown(share)} of all terms"
        f"{shown_floor(share, floor)}"
    )


def require_small(missed, sizes, share, floor, what):
    """Refuse unless each entry is within ``share`` of its size, or of ``floor`` times the largest of its column."""
    for j in range(missed.columns):
        largest = max((sizes.fraction(i, j) for i in range(sizes.rows)), default=Fraction(0))
        for i in range(missed.rows):
            allowed = share * max(sizes.fraction(i, j), floor * largest)
            require(abs(missed.fraction(i, j)) <= allowed, f"{what}: entry {i + 1}, {j + 1} does not hold")


# 5. Claims over a region: plants and observers that change with parameters -------------------------------------------


#: What a file has at each vertex, and of everything else once.
SCHEDULED = {"plant": {"A", "B", "Bf", "Bd", "Bw"}, "observer": {"Az", "Bu", "By"}}


class Region:
    """The systems at the vertices of a region, of which plant and observer are means with weights of any course.

    With weights ``w_i >= 0`` of sum one, which may change in any way from sample to sample, the plant has
    ``A(w) = sum of w_i A_i``, and likewise Bu, Bf, Bd and Bw; the observer, with the same weights at the same sample,
    has Az(w), Bu(w) and By(w).  All else (E, T and what outputs and rows are of states and signals) does not change, so
    that what ``System.identities`` and ``System.driven`` form is the mean of what they form at the vertices.

    In continuous time there is one Lyapunov matrix; in discrete time one, or one for each vertex.  Then
    ``V = e' P(w) e`` with ``P(w) = sum of w_i P_i``, and each inequality, which has P_i of the vertex i now and P_j of
    the next sample, is asked for every i and j.  For one j it is concave in the matrices of the error system, as P_j is
    positive definite, and linear in P_i: it holds for all means over i, and these hold for all means over j.
    """

    def __init__(self, file):
        require(isinstance(file["vertices"], list) and file["vertices"], "there are no vertices")
        self.systems = []
        for vertex in file["vertices"]:
            parts = {}
            for kind, names in SCHEDULED.items():
                require(set(vertex[kind]) == names, f"a vertex has exactly {', '.join(sorted(names))} of the {kind}")
                require(not names & set(file[kind]), f"a matrix of the {kind} is at the vertices and beside them")
                parts[kind] = {**file[kind], **vertex[kind]}
            self.systems.append(System({**file, **parts}))
        first = self.systems[0]
        require(first.T0.is_zero() and not first.lag, "over a region the rows add no equations and no past states")
        self.first, self.discrete, self.count = first, first.discrete, len(self.systems)
        self.witness, self.proved_contraction = file.get("contraction"), None
        self.words = f", for every course of the weights of the {self.count} vertices, jumps among them"

    def contraction(self, slow):
        """Return the contraction of the file, proved once: for slow courses of the weights, or for all."""
        require(self.witness is not None, "the file has no contraction")
        require(("step" in self.witness) == slow, "the contraction of the file is for other courses")
        if self.proved_contraction is None:
            self.proved_contraction = RegionContraction(self, self.witness)
        return self.proved_contraction

    def lyapunov_matrices(self, claim):
        """Return the positive definite P: one, or in discrete time one for each vertex."""
        order, most = self.first.Az.rows, self.count if self.discrete else 1
        matrices = [read_matrix(given) for given in claim["P"]]
        require(len(matrices) in (1, most), "there is one P, or one for each vertex of a sampled plant")
        for p, witness in zip(matrices, claim["P_positive"], strict=True):
            require(p.rows == order, "P does not fit")
            require_positive_definite(p, witness, "P")
        return matrices

    def require_at_all_pairs(self, matrices, witnesses, form, what):
        """Prove that ``form(system at i, P_i, P_j)`` is positive definite for every vertex i and next vertex j."""
        nexts = matrices if self.discrete else matrices[:1]
        needed = [(i, j) for i in range(self.count) for j in range(len(nexts))]
        require(len(witnesses) == len(needed), f"{what}: there is not a witness for each vertex and next vertex")
        for (i, j), witness in zip(needed, witnesses, strict=True):
            own = matrices[i] if len(matrices) > 1 else matrices[0]
            name = f"{what}, vertex {i + 1}" + (f", then {j + 1}" if len(nexts) > 1 else "")
            require_positive_definite(form(self.systems[i], own, nexts[j]), witness, name)

    def lyapunov(self, claim, rate):
        """Prove that ``e' P(w) e`` decreases faster than ``rate^(2k)`` or ``exp(-2 rate t)``; return the P."""
        matrices = self.lyapunov_matrices(claim)

        def form(system, p, after):
            if self.discrete:
                return p.times(rate).times(rate) - system.Az.T @ after @ system.Az
            half = system.Az.T @ p + p.times(rate)
            return -(half + half.T)

        self.require_at_all_pairs(matrices, claim["decreases"], form, "the Lyapunov inequality")
        return matrices


def between(one, two, weight):
    """Return the mean of two matrices, the second with a weight (a matrix of one entry)."""
    return one + (two - one).times(weight)


class SlowCourses:
    """Of two vertices of a sampled plant: what holds while the weight w of the second changes by at most a step.

    The pairs of w now and at the next sample, ``0 <= w, w+ <= 1``, ``|w+ - w| <= step``, are a polygon of six corners.
    ``V = e' P(w) e`` with ``P(w) = (1 - w) P_1 + w P_2``; a matrix S, the slack, is the same for all weights.  Each
    inequality below is linear in the pair, so that it holds for all pairs if it does at the corners.  It is of the form
    ``[[X, (S'a)'], [S'a, S + S' - P(w+)]] > 0`` and gives ``X > a' P(w+) a``: from ``(S - P)' P^-1 (S - P) >= 0``
    follows ``S' P^-1 S >= S + S' - P > 0``, so that S has an inverse, and with the Schur complement
    ``X > a' S (S + S' - P)^-1 S' a >= a' S (S' P^-1 S)^-1 S' a = a' P a``.
    """

    def __init__(self, region, given):
        require(region.discrete and region.count == 2, "slow courses are those of two vertices of a sampled plant")
        self.region, self.step, self.slack = region, read_matrix(given["step"]), read_matrix(given["slack"])
        order, none, one = region.first.Az.rows, Matrix.zero(1, 1), Matrix.identity(1)
        require(0 < self.step.number() <= 1, "the step of the weight is not between 0 and 1")
        require((self.slack.rows, self.slack.columns) == (order, order), "the slack does not fit")
        self.matrices, far = region.lyapunov_matrices(given), one - self.step
        require(len(self.matrices) == 2, "slow courses need a P for each vertex")
        self.corners = [(none, none), (none, self.step), (far, one), (one, one), (one, far), (self.step, none)]
        self.words = slow_words(self.step.number(), "from sample to sample")

    def require_at_corners(self, witnesses, form, what):
        """Prove that ``form(system parts at w, P(w), S + S' - P(w+))`` is positive definite at every corner."""
        require(len(witnesses) == len(self.corners), f"{what}: there is not a witness for each corner")
        for (now, then), witness in zip(self.corners, witnesses, strict=True):
            p, after = (between(*self.matrices, weight) for weight in (now, then))
            name = f"{what}, weight {shown(now.number())}, then {shown(then.number())}"
            require_positive_definite(form(now, p, self.slack + self.slack.T - after), witness, name)

    def moved(self, now):
        """Return ``S' Az`` at a weight."""
        return self.slack.T @ between(*(system.Az for system in self.region.systems), now)

    def driven(self, signal, now):
        """Return ``S' B`` of a signal at a weight, and D, which does not change."""
        (b, d), (other, _) = (system.driven(signal) for system in self.region.systems)
        return self.slack.T @ between(b, other, now), d

    def lyapunov(self, claim, rate, c=None):
        """Prove that ``rate^2 V(e) - V(e+) - |c e|^2`` is positive."""

        def form(now, p, lower):
            first = p.times(rate).times(rate)
            first, moved = first if c is None else first - c.T @ c, self.moved(now)
            return Matrix.blocks([[first, moved.T], [moved, lower]])

        self.require_at_corners(claim["decreases"], form, "the Lyapunov inequality")

    def bounded_real(self, claim, signal, rows):
        """Prove that ``V(e) - V(e+) - |c e + d s|^2 + gamma^2 |s|^2`` is positive."""
        gamma, c = read_matrix(claim["gamma"]), -self.region.first.Cz.part(rows)
        require(gamma.number() > 0, "gamma is not positive")

        def form(now, p, lower):
            moved, (driven, d) = self.moved(now), self.driven(signal, now)
            d = d.part(rows)
            level = Matrix.identity(d.columns).times(gamma).times(gamma) - d.T @ d
            across = -(c.T @ d)
            return Matrix.blocks([[p - c.T @ c, across, moved.T], [across.T, level, driven.T], [moved, driven, lower]])

        self.require_at_corners(claim["bounded_real"], form, "the bounded real inequality")

    def largest_trace(self, traces):
        """Return a bound of ``tr b' P(w+) b`` for the noise: the trace of W with ``[[W, (S'b)'], [S'b, ...]] > 0``."""
        covers, bounds = [each["covers"] for each in traces], [read_matrix(each["W"]) for each in traces]
        left = iter(bounds)

        def form(now, p, lower):
            driven, _ = self.driven("noise", now)
            return Matrix.blocks([[next(left), driven.T], [driven, lower]])

        self.require_at_corners(covers, form, "the bound of the noise")
        return max(trace(bound) for bound in bounds)


def slow_words(step, each):
    """Return of which courses of the weights of two vertices something is claimed."""
    return f", for every course of the weights of the 2 vertices, each of which changes by at most {shown(step)} {each}"


class SlowFlow:
    """Of two vertices of a plant in continuous time: what holds while the weight w of the second has ``|w'| <= rate``.

    ``V = e' P(w) e`` where P is a polynomial of degree d, given by its coefficients P_k in Bernstein's form: the sum of
    ``binomial(d, k) w^k (1 - w)^(d - k) P_k``.  The derivative of V has the term ``w' e' (dP/dw) e``, which is linear
    in w': an inequality is proved for ``w' = rate`` and for ``w' = -rate``.  It is a polynomial of degree d + 1 in w.
    On equal pieces of [0, 1] a polynomial is a mean of its coefficients there, with weights that are not negative:
    if these are positive definite on each piece, so is the polynomial.
    """

    def __init__(self, region, given):
        require(not region.discrete and region.count == 2, "a rate is one of two vertices in continuous time")
        self.region, self.rate, order = region, read_matrix(given["rate_of_weight"]), region.first.Az.rows
        self.pieces = read_count(given["pieces"], "the number of pieces", most=1024)
        require(self.rate.number() > 0, "the rate of the weight is not positive")
        require(self.pieces and self.pieces & (self.pieces - 1) == 0, "the number of pieces is no power of two")
        self.P = [read_matrix(each) for each in given["P"]]
        require(0 < len(self.P) <= 100 and all(p.rows == p.columns == order for p in self.P), "P does not fit")
        self.require_on_pieces(self.P, given["P_positive"], "P")
        self.words = slow_words(self.rate.number(), "in a unit of time")

    def require_on_pieces(self, coefficients, witnesses, what):
        """Prove that a polynomial with these coefficients is positive definite on [0, 1]."""
        found = [each for piece in on_pieces(coefficients, self.pieces) for each in piece]
        require(len(found) == len(witnesses), f"{what}: there is not a witness for each coefficient")
        for place, (matrix, witness) in enumerate(zip(found, witnesses, strict=True)):
            require_positive_definite(matrix, witness, f"{what}, coefficient {place + 1}")

    def slopes(self):
        """Return the coefficients of degree d of dP/dw, of which those of degree d - 1 are ``d (P_(j+1) - P_j)``."""
        last = len(self.P) - 1
        found = []
        for k, p in enumerate(self.P):
            slope = Matrix.zero(p.rows, p.rows)
            if k > 0:
                slope = slope + (p - self.P[k - 1]).times(whole(k))
            if k < last:
                slope = slope + (self.P[k + 1] - p).times(whole(last - k))
            found.append(slope)
        return found

    def bounded_real(self, claim, signal, rows):
        """Prove that ``gamma^2 |s|^2 - |c e + d s|^2 - dV/dt`` is positive, times d + 1.

        Coefficient k of the product of P with what is linear in w is ``(d + 1 - k) P_k X_1 + k P_(k-1) X_2``, divided
        by d + 1; so is that of dP/dw, and of what is constant.
        """
        gamma, degree, slopes = read_matrix(claim["gamma"]), len(self.P), self.slopes()

        def at(vertex, k, sign):
            system = self.region.systems[vertex]
            b, d = system.driven(signal)
            whole_form = bounded_real(
                False, gamma, self.P[k], self.P[k], system.Az, b, -system.Cz.part(rows), d.part(rows)
            )
            moved = slopes[k].times(self.rate).times(whole(sign))
            return whole_form - diagonal(moved, Matrix.zero(b.columns, b.columns))

        require(len(claim["bounded_real"]) == 2, "there are not witnesses for both signs of the rate")
        for sign, witnesses in zip((1, -1), claim["bounded_real"], strict=True):
            coefficients = []
            for k in range(degree + 1):
                parts = [at(0, k, sign).times(whole(degree - k))] if k < degree else []
                parts += [at(1, k - 1, sign).times(whole(k))] if k else []
                coefficients.append(total(parts))
            self.require_on_pieces(coefficients, witnesses, "the bounded real inequality")


def whole(number):
    """Return a whole number as a matrix of one entry."""
    return Matrix(1, 1, [[number]])


def on_pieces(coefficients, pieces):
    """Return the coefficients in Bernstein's form on each of some equal pieces of [0, 1]: halving by de Casteljau.

    Means of neighbours, means of these, and so on: the first of each row are the coefficients on the first half, the
    last of each those on the second half, backwards.
    """
    if pieces == 1:
        return [coefficients]
    low, high, row = [], [], coefficients
    while row:
        low.append(row[0])
        high.insert(0, row[-1])
        sums_of_two = [row[k] + row[k + 1] for k in range(len(row) - 1)]
        row = [Matrix(each.rows, each.columns, each.entries, each.exponent - 1) for each in sums_of_two]
    return on_pieces(low, pieces // 2) + on_pieces(high, pieces // 2)


class RegionContraction:
    """What columns k_i of inputs at the vertices do to a row: as ``Contraction``, with ``|e|^2 = e' P(w) e``.

    The norm of k(w) in P(w+) is at most the largest of ``k_i' P_j k_i``: it is convex in k, and linear in P.  One G
    with ``[P_j, I; I, G] > 0`` for every j is above the inverse of P(w).
    """

    def __init__(self, region, witness):
        rate, one = read_matrix(witness["rate"]), Matrix.identity(region.first.Az.rows)
        value = rate.number()
        require(0 < value < 1 if region.discrete else value > 0, "the rate is none of decay")
        if "step" in witness:
            courses = SlowCourses(region, witness)
            courses.lyapunov(witness, rate)
            self.matrices, self.words = courses.matrices, courses.words
        else:
            self.matrices, self.words = region.lyapunov(witness, rate), region.words
        g = read_matrix(witness["G"])
        for p, covers in zip(self.matrices, witness["G_covers"], strict=True):
            require_positive_definite(Matrix.blocks([[p, one], [one, g]]), covers, "G")
        self.slowness, rows = (1 - value if region.discrete else value), region.first.Cz
        self.heights = [(rows.part([i]) @ g @ rows.part([i]).T).number() for i in range(rows.rows)]

    def require_bounds(self, bounds, each_columns, each_own, what):
        """Refuse unless each bound is at least its largest own part, and what any of the columns adds to it."""
        first = each_own[0]
        require((bounds.rows, bounds.columns) == (first.rows, first.columns), f"the bounds for {what} do not fit")
        for j in range(first.columns):
            columns = [columns.part(None, [j]) for columns in each_columns]
            length = max((column.T @ p @ column).number() for column in columns for p in self.matrices)
            for i in range(first.rows):
                left = bounds.fraction(i, j) - max(own.fraction(i, j) for own in each_own)
                require(
                    left >= 0 and (left * self.slowness) ** 2 >= self.heights[i] * length,
                    f"the bound of row {i + 1} and column {j + 1} for {what} is not proved",
                )


def identities_hold_over_region(region, claim):
    """The identities (see ``identities_hold``) hold at every vertex, and so for all means of them."""
    sentences = [identities_hold(system, claim) for system in region.systems]
    return sentences[0] + region.words


def decays_over_region(region, claim, slow=False):
    """Errors decay: a Lyapunov inequality with a rate below one or, in continuous time, not below zero."""
    rate, words = read_matrix(claim["rate"]), region.words
    value = rate.number()
    require(0 < value < 1 if region.discrete else value > 0, "the rate is none of decay")
    if slow:
        courses = SlowCourses(region, claim)
        courses.lyapunov(claim, rate)
        words = courses.words
    else:
        region.lyapunov(claim, rate)
    factor = f"(1 - {shown(1 - value, down=True)})^k" if region.discrete else f"exp(-{shown(value, down=True)} t)"
    return f"errors decay faster than {factor}, up to a constant factor{words}"


def gain_is_below_over_region(region, claim, slow=False):
    """The l2 gain from a signal to the errors of some rows is below gamma: the bounded real lemma with V of P(w)."""
    rows, gamma, words = region.first.rows_of_each(claim["rows"]), claim["gamma"], region.words

    def form(system, p, after):
        b, d = system.driven(claim["signal"])
        c, d = -system.Cz.part(rows), d.part(rows)
        return bounded_real(region.discrete, read_matrix(gamma), p, after, system.Az, b, c, d)

    if slow:
        courses = SlowCourses(region, claim) if region.discrete else SlowFlow(region, claim)
        courses.bounded_real(claim, claim["signal"], rows)
        words = courses.words
    else:
        matrices = region.lyapunov_matrices(claim)
        region.require_at_all_pairs(matrices, claim["bounded_real"], form, "the bounded real inequality")
    return (
        f"the l2 gain from the {claim['signal']} to the error of the {' and '.join(claim['rows'])} rows is below "
        f"{shown(read_matrix(gamma).number())}{words}"
    )


def mean_square_is_below(region, claim, slow=False):
    """Under white noise of unit variance the errors of some rows have together at most this root mean square.

    The mean of ``V(e+)`` is that of ``e' a' P(w+) a e``, and ``tr b' P(w+) b``, as e depends on earlier noise alone.
    If ``a' P(w+) a + c'c < P(w)`` and ``tr b' P(w+) b + tr d'd <= level^2``, then ``|r|^2`` has at most the mean
    ``level^2 + V(e) - V(e+)``, and averaged over more and more samples at most ``level^2``.
    """
    require(region.discrete, "the claim is for sampled plants")
    rows, words = region.first.rows_of_each(claim["rows"]), region.words
    c, level = region.first.Cz.part(rows), read_matrix(claim["level"]).number()
    require(level > 0, "the level is not positive")

    def form(system, p, after):
        return p - system.Az.T @ after @ system.Az - c.T @ c

    directs = [system.driven("noise")[1].part(rows) for system in region.systems]
    direct = max(trace(d.T @ d) for d in directs)
    if slow:
        courses = SlowCourses(region, claim)
        courses.lyapunov(claim, Matrix.identity(1), c)
        require(courses.largest_trace(claim["traces"]) + direct <= level**2, "the mean square is not proved")
        words = courses.words
    else:
        matrices = region.lyapunov_matrices(claim)
        region.require_at_all_pairs(matrices, claim["decreases"], form, "the inequality of the mean square")
        for system in region.systems:
            b, _ = system.driven("noise")
            for after in matrices:
                require(trace(b.T @ after @ b) + direct <= level**2, "the mean square is not proved")
    return (
        f"the errors of the {' and '.join(claim['rows'])} rows, averaged over the samples in the long run, have "
        f"together a root mean square of at most {shown(level)} under white noise as modelled, which the parameters do "
        f"not depend on{words}"
    )


def trace(matrix):
    """Return the sum of the diagonal."""
    return sum((matrix.fraction(i, i) for i in range(matrix.rows)), Fraction(0))


def rounding_adds_little_over_region(region, claim, slow=False):
    """What rounding of the stored numbers adds to each row, see ``rounding_adds_little``; J, L and W do not change."""
    contraction, worst = region.contraction(slow), Fraction(0)
    found = [system.identities() for system in region.systems]
    pairs = {"states": ("K", "J"), "inputs": ("U", "L")}
    pairs |= {"disturbances": ("V", "W")} if region.first.decoupled else {}
    require(set(claim["bounds"]) == set(pairs), "there are not bounds for each kind of signal")
    for kind, (moved, seen) in pairs.items():
        bounds, own = read_matrix(claim["bounds"][kind]), [each[seen][0].absolute() for each in found]
        contraction.require_bounds(bounds, [each[moved][0] for each in found], own, kind)
        worst = max([worst, *entries_of(bounds)])
        if kind == "states":
            require_faults_are_seen(region.first, bounds)
    listed = "state, input or disturbance" if region.first.decoupled else "state or input"
    return f"rounding adds at most {shown(worst)} to any row, per unit of any {listed}{contraction.words}"


def faults_are_estimated_over_region(region, claim, slow=False):
    """A fault of any course shows in its own estimate one sample later, and in no other row, but for rounding.

    A fault impulse leaves ``b_j`` in e, with weights of all j, and ``a_i b_j`` a sample later: row r responds with d at
    once and with ``-c b_j`` after a sample, which should be one where r is named like the fault and zero elsewhere.
    What is left after that starts with the columns ``a_i b_j`` (see ``RegionContraction``).
    """
    require(region.discrete, "the claim is for sampled filters")
    system, bounds, moved, own = region.first, read_matrix(claim["bounds"]), [], []
    delays = {name: delay for kind, name, delay in system.row_kinds if kind == "fault"}
    require(set(delays) == set(system.names["faults"]), "not every fault is estimated")
    require(len(delays) == len(system.rows_of(["fault"])), "a fault has two estimates")
    require(set(delays.values()) == {1}, "over a region a fault is estimated a sample later")
    wanted = Matrix.zero(system.Cz.rows, system.Bf.columns)
    for i, (kind, name, _) in enumerate(system.row_kinds):
        if kind in ("fault", "residual") and name in delays:
            wanted.entries[i][system.index("faults", name)] = 1
    for one in region.systems:
        b, d = one.driven("faults")
        own.append(d.absolute() + (system.Cz @ b + wanted).absolute())
        moved += [other.Az @ b for other in region.systems]
    contraction = region.contraction(slow)
    contraction.require_bounds(bounds, moved, own, "faults")
    for i in system.rows_of(["fault"]):
        require(bounds.fraction(i, system.index("faults", system.row_kinds[i][1])) <= LARGEST_SHARE, NOT_ITS_FAULT)
    return (
        f"each fault is estimated as it was a sample ago, and shows nowhere else, to {shown(max(entries_of(bounds)))} "
        f"per unit of it{contraction.words}"
    )


#: Claims of files with vertices.
REGION_CLAIMS = {
    "identities over the region": identities_hold_over_region,
    "decay over the region": decays_over_region,
    "rounding over the region": rounding_adds_little_over_region,
    "gain over the region": gain_is_below_over_region,
    "mean square over the region": mean_square_is_below,
    "faults over the region": faults_are_estimated_over_region,
    "decay for slow courses": lambda region, claim: decays_over_region(region, claim, slow=True),
    "rounding for slow courses": lambda region, claim: rounding_adds_little_over_region(region, claim, slow=True),
    "gain for slow courses": lambda region, claim: gain_is_below_over_region(region, claim, slow=True),
    "mean square for slow courses": lambda region, claim: mean_square_is_below(region, claim, slow=True),
    "faults for slow courses": lambda region, claim: faults_are_estimated_over_region(region, claim, slow=True),
}


# 6. Claims on windows of samples: guaranteed tests and alarms -------------------------------------------------------


class Window:
    """The equations of a plant over some samples, ``M z = b``, with a bound for each entry of z, or none.

    Rows are ``E x(k+1) - A x(k) - Bf f(k) - Bd d(k) - G w(k) = B u(k)`` for the equations from ``-prior`` on, and
    ``C x(k) + Df f(k) + Dd d(k) + H w(k) = y(k) - D u(k)`` for the samples 0 to ``samples - 1``.  Entries of z are the
    size theta of the fault that is looked for, states, noise w, disturbances d, and what else the faults do.  Bounds of
    disturbances and noise are about ``middles``, which are moved to the right.  Disturbances that move between samples
    enter each equation by the columns of ``between_samples`` with bounds of their own, in place of Bd or beside it.
    """

    def __init__(self, system, question):
        require(system.discrete, "a window needs samples")
        self.system, self.question = system, question
        self.samples, self.prior, self.equations, self.fault, self.lag, self.before = (
            read_count(question[key], key) for key in ("samples", "prior", "equations", "fault", "lag", "before")
        )
        require(self.samples >= 1, "the window has no samples")
        require(self.samples + self.prior + self.equations <= LARGEST_COUNT, "the window is too long")
        require(self.fault < system.Bf.columns, "there is no such fault")
        require(max(self.lag, self.before) < self.samples, "the fault begins, or is looked for, outside of the window")
        require(question["norm"] in ("box", "ellipsoid"), "the norm is unknown")
        self.free = [read_count(fault, "a free fault", most=system.Bf.columns - 1) for fault in question["free"]]
        self.G, self.H = read_matrix(question["noise_state"]), read_matrix(question["noise_output"])
        shapes = (self.G.rows, self.G.columns), (self.H.rows, self.H.columns)
        require(shapes == ((system.E.rows, self.G.columns), (system.C.rows, self.G.columns)), "the noise does not fit")
        self.limits = self.read_limits()
        self.bounds, self.groups, self.entries, self.offsets = [], [], [], []
        self.row_count = self.equations * system.E.rows + self.samples * system.C.rows
        self.fill()

    def read_limits(self):
        """Read the bounds, one for each signal; only states and rates of change may have none."""
        system = self.system
        n, nd, nw = system.E.rows, system.Bd.columns, self.G.columns
        counts = {"disturbances": nd, "noise": nw, "states": n, "first": n, "rates": nd, "fault_rate": 1}
        given, middles = self.question["bounds"], self.question["middles"]
        require(set(given) == set(counts) and set(middles) == {"disturbances", "noise"}, "bounds are missing")
        require(all(len(given[name]) == count for name, count in counts.items()), "each signal needs a bound")
        require(all(len(values) == counts[name] for name, values in middles.items()), "each bound needs a middle")
        limits = {name: [None if v is None else read_matrix(v).number() for v in values]
                  for name, values in given.items()}  # fmt: skip
        require(None not in limits["disturbances"] + limits["noise"], "each signal needs a bound")
        return limits

    def column(self, bound, group=None):
        """Add an entry of z with its bound (none: free), and return its number."""
        require(bound is None or bound >= 0, "a bound is negative")
        self.bounds.append(bound)
        self.groups.append(group)
        return len(self.bounds) - 1

    def put(self, row, column, value):
        """Add a number to M."""
        if value:
            self.entries.append((row, column, value))

    def equation(self, k, i):
        """Return the row of equation i of the step from k to k + 1; None outside of the window."""
        place = k + self.prior
        return place * self.system.E.rows + i if 0 <= place < self.equations else None

    def output(self, k, i):
        """Return the row of output i at sample k; None outside of the window."""
        first = self.equations * self.system.E.rows
        return first + k * self.system.C.rows + i if 0 <= k < self.samples else None

    def acts(self, k, state, output, i, column, times=1, in_states=True):
        """Let a column of z act at k as signal i does, by these matrices of states and outputs."""
        for r in range(state.rows) if in_states else ():
            row = self.equation(k, r)
            if row is not None:
                self.put(row, column, -times * state.fraction(r, i))
        for r in range(output.rows):
            row = self.output(k, r)
            if row is not None:
                self.put(row, column, times * output.fraction(r, i))

    def fill(self):
        """Form M."""
        system, question, bounds = self.system, self.question, self.limits
        span = range(-self.prior, max(self.equations - self.prior, self.samples))
        self.theta = self.column(None)
        n = system.E.rows
        states = {}
        for k in range(-self.prior, self.equations - self.prior + 1):
            for i in range(n):
                bound = bounds["states"][i]
                if k == 0 and bounds["first"][i] is not None:
                    bound = bounds["first"][i] if bound is None else min(bound, bounds["first"][i])
                states[k, i] = self.column(bound)
        for k in range(-self.prior, self.equations - self.prior):
            for r in range(n):
                for i in range(n):
                    self.put(self.equation(k, r), states[k + 1, i], system.E.fraction(r, i))
                    self.put(self.equation(k, r), states[k, i], -system.A.fraction(r, i))
        for k in range(self.samples):
            for r in range(system.C.rows):
                for i in range(n):
                    require((k, i) in states or not system.C.fraction(r, i), "a sample is seen without its state")
                    if (k, i) in states:
                        self.put(self.output(k, r), states[k, i], system.C.fraction(r, i))
        for k in span:
            for i, bound in enumerate(bounds["noise"]):
                if bound:
                    self.acts(k, self.G, self.H, i, self.column(bound, ("w", k)))
        self.disturb(bounds, span)
        self.look_for(bounds, span)
        for fault in self.free:
            require(fault != self.fault, "the fault that is looked for is free")
            column = None
            for k in span:
                if column is None or question["free_course"] == "any":
                    column = self.column(None)
                self.acts(k, system.Bf, system.Df, fault, column)
        require(question["free_course"] in ("any", "constant"), "the course of free faults is unknown")
        self.move_middles(bounds, span)

    def disturb(self, bounds, span):
        """Disturbances: new at each sample (any, jump), the same at all (held), or with bounded changes (rate)."""
        system, kind, between = self.system, self.question["disturbance"], self.question.get("between_samples")
        require(kind in ("any", "jump", "held", "rate"), "the course of disturbances is unknown")
        require(between is None or kind in ("any", "rate"), "disturbances that are held do not move between samples")
        replaced = between["replaced"] if between else []
        for i, bound in enumerate(bounds["disturbances"]):
            before = column = None
            for k in span if bound else ():
                if column is None or kind != "held":
                    column = self.column(bound, ("d", k) if kind in ("any", "jump") else None)
                self.acts(k, system.Bd, system.Dd, i, column, in_states=i not in replaced)
                if kind == "rate" and before is not None:
                    change = self.column(bounds["rates"][i])
                    for place, value in ((column, 1), (before, -1), (change, -1)):
                        self.put(self.row_count, place, value)
                    self.row_count += 1
                before = column
        if between:
            self.move(between)

    def move(self, between):
        """What disturbances that move between samples put into the equations of each."""
        columns = read_matrix(between["columns"])
        bounds = [read_matrix(bound).number() for bound in between["bounds"]]
        require(columns.rows == self.system.E.rows, "the columns of moving disturbances do not fit")
        require(len(bounds) == len(between["groups"]) == columns.columns, "each column needs a bound and a group")
        for k in range(-self.prior, self.equations - self.prior):
            for j, (bound, group) in enumerate(zip(bounds, between["groups"], strict=True)):
                column = self.column(bound, None if group is None else ("moving", k, read_integer(group)))
                for r in range(columns.rows):
                    self.put(self.equation(k, r), column, -columns.fraction(r, j))

    def assumed(self, down):
        """Return what is assumed of the signals, and not proved here; bounds are rounded to the safe side."""
        system, question = self.system, self.question
        disturbances, noise, states = (self.limits[kind] for kind in ("disturbances", "noise", "states"))
        middles = {kind: [read_matrix(v).number() for v in values] for kind, values in question["middles"].items()}

        def within(bound, middle=0):
            return f"within {shown(bound, down)}" + (f" of {shown(middle)}" if middle else "")

        names = system.names["disturbances"]
        parts = [
            f"{name} {within(*pair)}" for name, *pair in zip(names, disturbances, middles["disturbances"], strict=True)
        ]
        parts += [f"noise {i + 1} {within(*pair)}" for i, pair in enumerate(zip(noise, middles["noise"], strict=True))]
        bounded = [*zip(system.names["states"], states, strict=True)]
        bounded += [
            (f"{name} at first", bound)
            for name, bound in zip(system.names["states"], self.limits["first"], strict=True)
        ]
        parts += [f"{name} {within(bound)}" for name, bound in bounded if bound is not None]
        others = [name for i, name in enumerate(system.names["faults"]) if i not in (self.fault, *self.free)]
        parts += [f"no {name}" for name in others]
        parts += ["disturbances and noise of a sample in an ellipsoid"] if question["norm"] == "ellipsoid" else []
        if any(disturbances):
            kinds = {"held": "disturbances that are constant", "rate": "disturbances with bounded changes"}
            parts += [kinds[question["disturbance"]]] if question["disturbance"] in kinds else []
            moving = question.get("between_samples")
            parts.append("disturbances that " + ("act as its columns say" if moving else "are held between samples"))
        return ", for " + ", ".join(parts) if parts else ""

    def look_for(self, bounds, span):
        """The fault that is looked for: what theta does, and what else this fault may do."""
        system, course, fault = self.system, self.question["course"], self.fault
        target = self.samples - 1 - self.lag
        require(course in ("step", "constant", "any", "ramp", "rate"), "the course of the fault is unknown")

        def acts(k, column, times=1):
            self.acts(k, system.Bf, system.Df, fault, column, times)

        slope = self.column(None) if course == "ramp" else None
        for k in span:
            if course != "any" and not (course == "step" and k < self.before):
                acts(k, self.theta)
            if course == "ramp":
                acts(k, slope, k - target)
            if course == "any":
                acts(k, self.theta if k == target else self.column(None))
        for k in list(span)[1:] if course == "rate" else ():
            change = self.column(bounds["fault_rate"][0])
            for there in span:
                if k > target and there >= k:
                    acts(there, change)
                if k <= target and there < k:
                    acts(there, change, -1)

    def move_middles(self, bounds, span):
        """What the middles of bounds put into each row, to be taken from the right side."""
        system, self.offsets = self.system, [Fraction(0)] * self.row_count
        matrices = {"disturbances": (system.Bd, system.Dd), "noise": (self.G, self.H)}
        for kind, (state, output) in matrices.items():
            for i, number in enumerate(self.question["middles"][kind]):
                middle = read_matrix(number).number()
                for k in span if middle else ():
                    for r in range(state.rows):
                        if self.equation(k, r) is not None:
                            self.offsets[self.equation(k, r)] -= middle * state.fraction(r, i)
                    for r in range(output.rows):
                        if self.output(k, r) is not None:
                            self.offsets[self.output(k, r)] += middle * output.fraction(r, i)

    def seen(self, multipliers):
        """Return ``M' lambda``."""
        found = [Fraction(0)] * len(self.bounds)
        for column, value in sums((c, v, multipliers[r]) for r, c, v in self.entries).items():
            found[column] = value
        return found

    def largest(self, parts):
        """Return at least the largest sum of ``part * entry``, the entries being within their bounds.

        With the norm ``ellipsoid`` the entries of one sample, in their bounds, keep a sum of squares of at most one.
        """
        alone, groups = Fraction(0), {}
        for part, bound, group in zip(parts, self.bounds, self.groups, strict=True):
            if bound:
                if self.question["norm"] == "ellipsoid" and group is not None:
                    groups[group] = groups.get(group, 0) + (bound * part) ** 2
                else:
                    alone += abs(part) * bound
        return alone + sum(map(root_above, groups.values()), Fraction(0))

    def weights(self, multipliers):
        """Return what ``lambda' b`` makes of y and u, by sample: ``{k: row of numbers}`` for each."""
        system, on_y, on_u = self.system, {}, {}
        for k in range(-self.prior, max(self.equations - self.prior, self.samples)):
            of_y = [
                multipliers[self.output(k, r)] if self.output(k, r) is not None else Fraction(0)
                for r in range(system.C.rows)
            ]
            on_y[k] = of_y
            on_u[k] = []
            for j in range(system.B.columns):
                value = -sum((of_y[r] * system.D.fraction(r, j) for r in range(system.C.rows)), Fraction(0))
                if 0 <= k + self.prior < self.equations:
                    value += sum(
                        (multipliers[self.equation(k, r)] * system.B.fraction(r, j) for r in range(system.E.rows)),
                        Fraction(0),
                    )
                on_u[k].append(value)
        return on_y, on_u


def sums(terms):
    """Return the sums of products by key."""
    found = {}
    for key, one, two in terms:
        if one and two:
            found[key] = found.get(key, 0) + one * two
    return found


def root_above(value):
    """Return a number at least as large as the square root of a fraction."""
    from math import isqrt

    scale = 2**256
    numerator = isqrt(value.numerator * scale * scale // value.denominator + 1) + 1
    return Fraction(numerator, scale)


def read_fractions(given, count):
    """Read a list of fractions with one denominator."""
    denominator, entries = read_integer(given["denominator"]), [read_integer(v) for v in given["numerators"]]
    require(denominator > 0 and len(entries) == count, "the multipliers do not fit the window")
    return [Fraction(value, denominator) for value in entries]


def threshold_holds(system, claim):
    """A guaranteed test never passes its threshold while its fault is absent.

    Multipliers lambda weigh every free entry of z with zero and theta with one: ``lambda' b = theta + sum of
    (M' lambda)_j z_j`` over the entries with bounds, whose sum is at most the threshold.  So without the fault
    ``|lambda' b| <= threshold``, and a fault above twice the threshold passes it.  The weights that run are the
    response of the observer's row; per unit of each known signal they differ from those of lambda by ``rounding``.
    """
    window = Window(system, claim["window"])
    multipliers = read_fractions(claim["multipliers"], window.row_count)
    seen, threshold = window.seen(multipliers), read_matrix(claim["threshold"]).number()
    require(seen[window.theta] == 1, "the fault does not count with weight one")
    free = [j for j, bound in enumerate(window.bounds) if bound is None and j != window.theta]
    require(not any(seen[j] for j in free), "a signal without a bound reaches the test")
    seen[window.theta] = Fraction(0)
    require(window.largest(seen) <= threshold, "the threshold is not proved")
    added, offset = require_weights_run(system, claim, window, multipliers)
    return (
        f"without {system.names['faults'][window.fault]}, its test never passes {shown(threshold)} (and what rounding "
        f"of its weights adds: at most {shown(offset)}, and {shown(added)} per unit of any input or output), and a "
        f"fault ({claim['window']['course']}) of twice that passes it{window.assumed(down=True)}"
    )


def require_weights_run(system, claim, window, multipliers):
    """Refuse unless the observer's row has the weights of the multipliers; return what rounding adds, at most."""
    row, rounding = read_count(claim["row"], "the row"), [read_matrix(value).number() for value in claim["rounding"]]
    require(row < system.Cz.rows and len(rounding) == system.B.columns + system.C.rows, "there is no such row")
    require(system.row_kinds[row][1] == system.names["faults"][window.fault], "the row is of another fault")
    on_y, on_u = window.weights(multipliers)
    used = [k for k in on_y if any(on_y[k]) or any(on_u[k])]
    last, state = max([*used, window.samples - 1]), system.Cz.part([row])
    missed = [Fraction(0)] * len(rounding)
    response = (system.Du.part([row]), system.Dy.part([row]))
    for k in range(last, -window.prior - 1, -1):
        wanted = [*on_u[k], *on_y[k]]
        found = entries_of(response[0]) + entries_of(response[1])
        missed = [m + abs(a - b) for m, a, b in zip(missed, wanted, found, strict=True)]
        response = (state @ system.Bu, state @ system.By)
        state = state @ system.Az
    require(response[0].is_zero() and response[1].is_zero() and state.is_zero(), "the test looks at more samples")
    require(
        all(m <= r for m, r in zip(missed, rounding, strict=True)),
        "the weights that run are not those of the multipliers",
    )
    constant = -sum((m * offset for m, offset in zip(multipliers, window.offsets, strict=True)), Fraction(0))
    added = read_matrix(claim["constant_rounding"]).number()
    require(abs(read_matrix(claim["constant"]).number() - constant) <= added, "the constant of the test is another one")
    return max(rounding, default=Fraction(0)), added


def least_is_hidden(system, claim):
    """No function of a window's samples tells a fault of this size from its opposite: weak duality.

    A point z with ``M z = 0`` and theta = ``least`` keeps all bounds, and so does -z: both give the same samples.  The
    equations are those of the window, from ``prior`` steps before its first sample to the last of ``equations``.
    """
    window = Window(system, claim["window"])
    point, least = read_fractions(claim["point"], len(window.bounds)), read_matrix(claim["least"]).number()
    require(least >= 0 and point[window.theta] == least, "the point is of another fault")
    require(not any(sums((r, v, point[c]) for r, c, v in window.entries).values()), "the point violates an equation")
    groups = {}
    for j, (value, bound) in enumerate(zip(point, window.bounds, strict=True)):
        if bound is not None and j != window.theta:
            require(abs(value) <= bound, "the point violates a bound")
            if claim["window"]["norm"] == "ellipsoid" and window.groups[j] is not None and bound:
                groups[window.groups[j]] = groups.get(window.groups[j], 0) + (value / bound) ** 2
    require(all(value <= 1 for value in groups.values()), "the point violates a bound")
    fault = f"{system.names['faults'][window.fault]} ({claim['window']['course']})"
    begun = f"begins {window.prior} samples before the window" if window.prior else "begins with the window"
    return (
        f"for a plant that {begun}, no function of {window.samples} samples estimates {fault} to within "
        f"less than {shown(least, down=True)}{window.assumed(down=False)}"
    )


def alarm_is_right(system, claim):
    """These samples cannot occur without the fault: ``lambda' b`` passes what disturbances and noise can do.

    As in ``threshold_holds``, but lambda need not weigh theta: without the fault it is zero.
    """
    window = Window(system, claim["window"])
    multipliers = read_fractions(claim["multipliers"], window.row_count)
    seen = window.seen(multipliers)
    seen[window.theta] = Fraction(0)
    require(
        not any(value for value, bound in zip(seen, window.bounds, strict=True) if bound is None),
        "a free signal is seen",
    )
    y, u = read_matrix(claim["y"]), read_matrix(claim["u"])
    require(y.columns == system.C.rows and u.columns == system.B.columns and y.rows == u.rows, "the samples do not fit")
    require(window.prior == 0 and y.rows >= max(window.samples, window.equations), "there are too few samples")
    on_y, on_u = window.weights(multipliers)
    value = sum(
        (weight * y.fraction(k, r) for k, row in on_y.items() for r, weight in enumerate(row) if weight), Fraction(0)
    )
    value += sum(
        (weight * u.fraction(k, r) for k, row in on_u.items() for r, weight in enumerate(row) if weight), Fraction(0)
    )
    value -= sum((m * offset for m, offset in zip(multipliers, window.offsets, strict=True)), Fraction(0))
    allowed, margin = window.largest(seen), read_matrix(claim["margin"]).number()
    require(allowed > 0 and margin > 0, "nothing is uncertain, or the margin is not positive")
    require(abs(value) >= (1 + margin) * allowed, "the samples may occur without the fault")
    return (
        f"the {window.samples} samples of the alarm cannot occur without "
        f"{system.names['faults'][window.fault]}: all bounds would have to be exceeded by "
        f"{shown(margin * 100, down=True)} %{window.assumed(down=True)}"
    )


#: What reading a file raises that is not what the format says.
UNREADABLE = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
#: Claims on the error system: they are about the observer's errors only where the identities hold.
REST_ON_IDENTITIES = (
    *("gain", "matching", "deviation", "faults", "fault models"),
    *("gain over the region", "mean square over the region", "faults over the region"),
    *("gain for slow courses", "mean square for slow courses", "faults for slow courses"),
)
CLAIMS = {
    "plant": plant_follows,
    "identities": identities_hold,
    "stable": stable,
    "gain": gain_is_below,
    "matching": matching_is_close,
    "deviation": deviation_is_below,
    "rounding": rounding_adds_little,
    "faults": faults_are_estimated,
    "fault models": fault_models_are_followed,
    "threshold": threshold_holds,
    "least": least_is_hidden,
    "alarm": alarm_is_right,
}


# 7. Reading, and verdicts -------------------------------------------------------------------------------------------


def read_integer(value):
    """Read an integer: a number of JSON, or hexadecimal digits in quotes where it is long."""
    if isinstance(value, str):
        require(set(value.removeprefix("-")) <= set("0123456789abcdef") and value not in ("", "-"), "not an integer")
        return int(value, 16)
    require(isinstance(value, int) and not isinstance(value, bool), "not an integer")
    return value


def read_count(value, what, most=LARGEST_COUNT):
    """Read a number of things: from zero to a limit."""
    number = read_integer(value)
    require(0 <= number <= most, f"{what} is not from 0 to {most}")
    return number


def read_names(given, count, kind):
    """Read the names of some signals: one for each, no two alike."""
    require(isinstance(given, list) and all(isinstance(name, str) for name in given), f"names of {kind} are no texts")
    require(len(given) == count == len(set(given)), f"the {kind} need a name each, no two alike")
    return given


def read_matrix(given):
    """Read a matrix: its size, its exponent, and its integers row by row (``entry * 2**exponent``)."""
    rows, columns = (read_count(value, "a size") for value in given["size"])
    exponent, entries = read_integer(given["exponent"]), given["entries"]
    require(isinstance(entries, list) and rows * columns == len(entries), "a matrix has another size than it says")
    require(abs(exponent) <= LARGEST_EXPONENT, "an exponent is too large")
    integers = [read_integer(value) for value in entries]
    return Matrix(rows, columns, [integers[i * columns : (i + 1) * columns] for i in range(rows)], exponent)


def check(file):
    """Return for each claim its name, whether it is proved, and the sentence or the reason; and what is not covered."""
    require(isinstance(file, dict), "this is no proof file")
    require(file.get("format") == FORMAT, "this is no proof file")
    require(read_integer(file.get("version")) == VERSION, f"the version of the file is not {VERSION}")
    over_region, left = "vertices" in file, file.get("not_covered", [])
    about, claims = (Region(file), REGION_CLAIMS) if over_region else (System(file), CLAIMS)
    require(isinstance(file["claims"], list) and file["claims"], "there are no claims")
    require(isinstance(left, list), "what is not covered is no list")
    verdicts = []
    for claim in file["claims"]:
        name = str(claim.get("claim"))
        try:
            require(name in claims, "this program knows no such claim: it is not proved")
            verdicts.append((name, True, claims[name](about, claim)))
        except Refused as refused:
            verdicts.append((name, False, str(refused)))
        except UNREADABLE as error:
            verdicts.append((name, False, f"the claim cannot be read: {type(error).__name__} {error}"))
    identities = "identities over the region" if over_region else "identities"
    follows = any(name == identities and proved for name, proved, _ in verdicts)
    missing = f"it is about errors only where the claim '{identities}' is proved, too"
    verdicts = [
        (name, False, missing) if proved and name in REST_ON_IDENTITIES and not follows else (name, proved, text)
        for name, proved, text in verdicts
    ]
    return verdicts, [str(text) for text in left]


def read_file(path):
    """Read JSON with integers alone, in which no name occurs twice: one reader might take the first, one the last."""

    def unique(pairs):
        require(len(dict(pairs)) == len(pairs), "a name occurs twice")
        return dict(pairs)

    def refuse(text):
        raise Refused(f"{text} is no integer")

    with open(path, encoding="utf-8") as stream:
        return json.load(stream, object_pairs_hook=unique, parse_float=refuse, parse_constant=refuse)


def on_one_line(text):
    """Return a text of the file without what could pass for a line of this program."""
    return "".join(letter if letter.isprintable() else "?" for letter in str(text))


def main(arguments):
    """Check one file, print what is proved, and return the exit code."""
    if len(arguments) != 1:
        print("usage: python -I check_proof.py proof.json", file=sys.stderr)
        return 2
    try:
        file = read_file(arguments[0])
        verdicts, left = check(file)
    except (OSError, Refused, RecursionError, MemoryError, *UNREADABLE) as error:
        print(on_one_line(f"Not a proof file that can be checked: {type(error).__name__}: {error}"), file=sys.stderr)
        return 2
    print(on_one_line(f"About (not checked): {file.get('about', '')}"))
    for name, proved, text in verdicts:
        print(on_one_line(f"{'PROVED' if proved else 'NOT PROVED'}  {name}: {text}"))
    for text in left:
        print(on_one_line(f"NOT COVERED by this file: {text}"))
    known = REGION_CLAIMS if "vertices" in file else CLAIMS
    print(f"NOT CLAIMED by this file: {', '.join(sorted(set(known) - {name for name, _, _ in verdicts})) or 'nothing'}")
    if all(proved for _, proved, _ in verdicts):
        print(f"All {len(verdicts)} claims are proved, for the numbers in this file.")
        return 0
    print(f"{sum(not proved for _, proved, _ in verdicts)} of {len(verdicts)} claims are NOT PROVED.")
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
