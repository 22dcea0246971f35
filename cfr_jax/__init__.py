"""Fast learned registration of 3D point clouds in JAX.

    import cfr_jax as cfr

    result = cfr.align("source.ply", "target.ply")   # any size, units, offset; on the host
    result = cfr.register(cfr.load_params(), x, y)    # the pure JAX function under it

Names load on first use, so that importing the package (and `cfr --help`) does not import JAX.
"""

import importlib

__version__ = "0.1.0"

_HOMES = {
    "Alignment": "alignment.answers",
    "align": "alignment.align",
    "Outcome": "batch.stream",
    "align_many": "batch.stream",
    "Cloud": "networks.inputs",
    "Encoded": "networks.cfr.iterations",
    "Registration": "networks.cfr.registration",
    "Settings": "networks.inputs",
    "encode": "networks.cfr.registration",
    "prepare": "networks.inputs",
    "register": "networks.cfr.registration",
    "load_params": "weights.files",
    "save_params": "weights.files",
    "CloudFileError": "io",
    "PointCloud": "io",
}

__all__ = ["__version__", *sorted(_HOMES)]


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__():
    return __all__
