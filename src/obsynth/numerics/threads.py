"""One BLAS thread for small problems, while they run: two cost more than they give.

BLAS libraries know only one number of threads for the whole process, so it is set on entry and put back on exit, also
when an error is raised.  One block at a time sets it: of two that overlap in different Python threads, the second would
save what the first had set, and leave that behind.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

#: Problems with fewer states than this run on one BLAS thread: two took more time wherever they were measured, up to
#: twelve times as much at 100 states (``benchmarks/README.md``).
STATES_WORTH_THREADS = 1000

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
