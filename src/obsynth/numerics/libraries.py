"""Behaviour of numerical libraries: failures in double precision, missing packages, and BLAS threads.

BLAS knows one number of threads for the whole process: it is set on entry and put back on exit, by one block at a time.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from obsynth.errors import SolverError, SpecError
from obsynth.numerics.lapack import library

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


#: How scipy says, by a ValueError, that an overflow has reached LAPACK, or that LAPACK cannot reorder a Schur form.
_NUMERICAL_VALUE_ERRORS = ("infs or NaNs", "too far from generalized Schur form")

#: Problems with fewer states than this run on one BLAS thread: two took more time wherever they were measured, up to
#: twelve times as much at 100 states (``benchmarks/README.md``).
STATES_WORTH_THREADS = 1000

_Function = TypeVar("_Function", bound=Callable[..., Any])

#: Held by the block that has set the number of threads.
_SETTING = threading.Lock()


def failure_of(error: Exception) -> SolverError | None:
    """Return the `SolverError` for an error of a library that is due to the numbers; `None` for any other error."""
    if isinstance(error, MemoryError):
        reason = str(error).rstrip(".")
        return SolverError(
            f"This does not fit into the memory{f' ({reason})' if reason else ''}. The result is inconclusive."
        )
    is_numerical = isinstance(error, (np.linalg.LinAlgError, ArithmeticError))
    if isinstance(error, ValueError):
        is_numerical = is_numerical or any(text in str(error) for text in _NUMERICAL_VALUE_ERRORS)
    if not is_numerical:
        return None
    return SolverError(
        f"LAPACK gave up ({str(error).rstrip('.')}): the numbers are beyond double precision. The result is "
        "inconclusive; look at the units of the plant and at the options."
    )


@contextmanager
def failed_computations() -> Iterator[None]:
    """Raise `SolverError` where LAPACK or the range of numbers fails; also a decorator."""
    try:
        yield
    except (np.linalg.LinAlgError, ArithmeticError, ValueError) as error:
        failure = failure_of(error)
        if failure is None:
            raise
        raise failure from error


def imported(module: str, *, extra: str | None, what: str = "This") -> Any:
    """Return a module; where it is not installed, raise `SpecError` with the one command that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        requirement = package if extra is None else f"'obsynth[{extra}]'"
        raise SpecError(
            f"{what} needs {package}, which is not installed: pip install {requirement}", path=package
        ) from error


@lru_cache(maxsize=1)
def _libraries(_modules: int) -> ThreadpoolController:
    """Return the libraries loaded by so many modules: looked for again only when there are more, as that takes long."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def one_thread_if_small(states: int) -> Iterator[None]:
    """Run a block on one BLAS thread below `STATES_WORTH_THREADS` states; inside or beside another, nothing is set."""
    if states >= STATES_WORTH_THREADS or not _SETTING.acquire(blocking=False):
        yield
        return
    try:
        library()  # SciPy has a BLAS of its own, which must be loaded to be limited
        with _libraries(len(sys.modules)).limit(limits=1, user_api="blas"):
            yield
    finally:
        _SETTING.release()


def on_one_thread_if_small(function: _Function) -> _Function:
    """Return a function of a plant or design, its first argument, that runs in `one_thread_if_small`."""

    @wraps(function)
    def limited(*arguments: Any, **options: Any) -> Any:
        subject = arguments[0] if arguments else options.get("plant")
        states = getattr(getattr(subject, "plant", subject), "nx", 0)
        with one_thread_if_small(states if isinstance(states, int) else 0):
            return function(*arguments, **options)

    return cast(_Function, limited)
