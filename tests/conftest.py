"""How every test runs: warnings are errors, shapes and types are checked, dtypes never mix.

Imported before any test module, so that the checks are in place before `cfr_jax` is.
"""

import hashlib
import os
import typing
from pathlib import Path

import jax
import jaxtyping
import pytest
from oracle import authors

jaxtyping.install_import_hook("cfr_jax", "beartype.beartype")


def pytest_configure(config):
    # a cache that cannot be used makes the tests slower and nothing else
    config.addinivalue_line("filterwarnings", "ignore:.*persistent compilation cache:UserWarning")
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_compilation_cache_dir", str(_cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def pytest_sessionstart():
    # The fields of a result state the shapes of one pair. Coming out of vmap or a scan it is made
    # anew, with one more axis in front or with placeholders, and that is no mistake.
    from cfr_jax.alignment import case, confidence, quality, solving
    from cfr_jax.data.augmentation.pairs_on_device import Shapes
    from cfr_jax.networks import sinkhorn
    from cfr_jax.networks.cfr import registration
    from cfr_jax.networks.clues import NetworkClues
    from cfr_jax.training import losses
    from cfr_jax.training.step import TrainState

    for kind in (
        NetworkClues,
        registration.Cloud,
        registration.Encoded,
        registration.Registration,
        sinkhorn.Affinity,
        quality.Quality,
        confidence.Clues,
        solving.DeviceCloud,
        case.Found,
        losses.PairLoss,
        Shapes,
        TrainState,
    ):
        typing.no_type_check(kind.__init__)


def _cache_folder() -> Path:
    """A folder of this user's and this kind of processor's: compiled code is neither shared with
    other users nor run where an instruction is missing."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        processor = ""
    return home / "cfr_jax" / "tests" / hashlib.sha256(processor.encode()).hexdigest()[:12]


@pytest.fixture
def x64():
    """Float64 inside the test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def unchecked(monkeypatch):
    """Lets the test see what the library itself says of wrong arguments."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="session")
def state_dict():
    """Random weights as the authors' program would store them."""
    return authors.random_state_dict(0)


@pytest.fixture(scope="session")
def params(state_dict):
    """The same weights as ours."""
    from cfr_jax.weights.conversion import from_state_dict

    return from_state_dict(state_dict)


@pytest.fixture(scope="module", autouse=True)
def programs_of_one_file():
    """Compiled programs go when the file that used them is done. A process that keeps thousands of
    them runs out of memory maps, and XLA then dies with a segmentation fault."""
    yield
    from cfr_jax.runtime import programs

    programs._program.cache_clear()
    jax.clear_caches()
