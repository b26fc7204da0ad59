"""BLAS on one thread: the matrices of tracking are small."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property

from threadpoolctl import ThreadpoolController


class OneBlasThread:
    """A limit of the process that several of its threads may hold at a time; it ends with the last of them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._holders = 0

    @cached_property
    def _controller(self) -> ThreadpoolController:
        return ThreadpoolController()

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Limit BLAS to one thread within."""
        with self._lock:
            self._holders += 1
            if self._holders == 1:
                self._limit = self._controller.limit(limits=1, user_api="blas")
        try:
            yield
        finally:
            with self._lock:
                self._holders -= 1
                if self._holders == 0:
                    self._limit.restore_original_limits()


one_blas_thread = OneBlasThread()
"""On busy cores several BLAS threads track three times slower than one; and results do not depend on their number."""
