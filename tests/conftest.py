"""How every test runs: warnings are errors, shapes and types are checked, dtypes never mix.

Imported before any test module, so that the checks are in place before `cfr_jax` is.
"""

import hashlib
import os
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

install_import_hook("cfr_jax", "beartype.beartype")


def pytest_configure(config):
    config.addinivalue_line("filterwarnings", "error")
    # a cache that cannot be used makes the tests slower and nothing else
    config.addinivalue_line("filterwarnings", "ignore:.*persistent compilation cache:UserWarning")
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_compilation_cache_dir", str(_cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


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
