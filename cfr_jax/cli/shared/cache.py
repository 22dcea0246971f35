"""Keeps compiled programs between calls: compiling takes seconds, registering less than one."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

from cfr_jax.runtime.messages import Refused
from cfr_jax.runtime.private import make_private


def keep_compiled_programs() -> None:
    """Turns on JAX's compilation cache, in the user's cache folder.

    `CFR_JAX_CACHE` names another folder, or is "off". If JAX already has a cache
    (`JAX_COMPILATION_CACHE_DIR`), it stays as it is. Without a writable folder, calls are only
    slower. A folder that belongs to another user, or that others may write into, is not used, and
    standard error says so: whoever can write there could give any answer.
    """
    import jax

    wish = os.environ.get("CFR_JAX_CACHE", "")
    if wish == "off" or jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    try:
        folder = Path(wish) if wish else _user_folder()
        make_private(folder)
    except Refused as error:
        print(
            f"cfr: warning: {error}, so compiled programs are not kept there\n"
            "remove the folder, or name another one by CFR_JAX_CACHE",
            file=sys.stderr,
        )
        return
    except (OSError, RuntimeError):  # a file in the way, a read-only home, no home
        return
    if not os.access(folder, os.W_OK):
        return
    # A damaged or unwritable entry only costs time, and the JSON report shows the time.
    warnings.filterwarnings("ignore", message=".*persistent compilation cache")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    # imported here because it imports JAX
    from cfr_jax.runtime import programs

    programs.keep_in(folder)


def _user_folder() -> Path:
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "cfr_jax"
