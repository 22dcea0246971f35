"""Fast learned registration of 3D point clouds in JAX.

    import cfr_jax as cfr

    result = cfr.align("source.ply", "target.ply")   # any size, units, offset; on the host
    result = cfr.register(cfr.load_params(), x, y)    # the pure JAX function under it

Names load on first use, so that importing the package (and `cfr --help`) does not import JAX.
"""

from typing import TYPE_CHECKING

__version__ = "0.1.0"

__all__ = [
    "Alignment",
    "Cloud",
    "CloudFileError",
    "Encoded",
    "Outcome",
    "PointCloud",
    "Registration",
    "Settings",
    "__version__",
    "align",
    "align_many",
    "encode",
    "load_params",
    "prepare",
    "register",
    "save_params",
]

# Type checkers read the imports; the program looks names up in the table. A test holds the two to
# each other.
if TYPE_CHECKING:
    from cfr_jax.alignment.align import align
    from cfr_jax.alignment.answers import Alignment
    from cfr_jax.batch.stream import Outcome, align_many
    from cfr_jax.io import CloudFileError, PointCloud
    from cfr_jax.networks.cfr.iterations import Encoded
    from cfr_jax.networks.cfr.registration import Registration, encode, register
    from cfr_jax.networks.inputs import Cloud, Settings, prepare
    from cfr_jax.weights.files import load_params, save_params
else:
    from cfr_jax.runtime.lazy import loader

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

    __getattr__ = loader(__name__, _HOMES)

    def __dir__():
        return __all__
