"""Values that many threads may ask for, and only one of them computes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import Any


class Memo:
    """The last `most` values, by key. A thread that asks for a value in progress waits for it."""

    def __init__(self, most: int):
        self._most = most
        self._held: OrderedDict[Hashable, Future] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The value of `key`, computed by `make` if it is not there.

        If `make` raises, all waiting threads get the error, and nothing is kept.
        """
        with self._lock:
            mine = key not in self._held
            future = self._held.setdefault(key, Future())
            if mine:
                if len(self._held) > self._most:
                    self._held.popitem(last=False)
            self._held.move_to_end(key)
        if mine:
            try:
                future.set_result(make())
            except BaseException as error:
                with self._lock:
                    self._held.pop(key, None)
                future.set_exception(error)
        return future.result()
