"""One BLAS thread for small problems, while they run: two cost more than they give.

BLAS libraries know only one number of threads for the whole process, so it is set on entry and put back on exit, also
when an error is raised.  One block at a time sets it: of two that overlap in different Python threads, the second would
save what the first had set, and leave that behind.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from typing import TYPE_CHECKING, Any, TypeVar, cast

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

#: Problems with fewer states than this run on one BLAS thread: two took more time wherever they were measured, up to
#: twelve times as much at 100 states (``benchmarks/README.md``).
STATES_WORTH_THREADS = 1000

_Function = TypeVar("_Function", bound=Callable[..., Any])

#: Held by the block that has set the number of threads.
_SETTING = threading.Lock()


@lru_cache(maxsize=1)
def _libraries(_modules: int) -> ThreadpoolController:
    """Return the libraries loaded by so many modules: finding them takes longer than a small design, so only once.

    A library comes with a module that is imported, and they are looked for again when there are more.
    """
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def one_thread_if_small(states: int) -> Iterator[None]:
    """Run a block on one BLAS thread if the problem has fewer than `STATES_WORTH_THREADS` states.

    While another such block runs, inside this one or beside it, nothing is set: the number is that one's business.
    """
    if states >= STATES_WORTH_THREADS or not _SETTING.acquire(blocking=False):
        yield
        return
    try:
        import scipy.linalg  # noqa: F401 - SciPy has a BLAS of its own, which must be loaded to be limited

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
