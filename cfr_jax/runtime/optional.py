"""Libraries that not every installation has."""

from __future__ import annotations

import importlib
from types import ModuleType

_WAY_OUT = 'pip install "cfr_jax[baselines]"'
_ALONE = {"small_gicp": "pip install small-gicp"}
# Open3D's wheel does not include the system libraries that it needs.
_SYSTEM = "on Debian or Ubuntu also: apt-get install libusb-1.0-0 libgl1 libgomp1 libx11-6"


def require(module: str) -> ModuleType:
    """Imports and returns the module.

    Raises ModuleNotFoundError, in one line that says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        hint = f"{_WAY_OUT}; {_SYSTEM}" if module == "open3d" else way_out(module)
        why = str(error).splitlines()[0]
        raise ModuleNotFoundError(f"{module} is needed ({why}): {hint}", name=module) from None


def way_out(module: str) -> str:
    """The command that installs a module."""
    return _ALONE.get(module, _WAY_OUT)
