"""Memory of this process by Linux's own count."""

from __future__ import annotations

from pathlib import Path


def reset_peak() -> int:
    """Forgets the largest memory so far, and tells the present one in bytes."""
    Path("/proc/self/clear_refs").write_text("5")
    return memory("VmRSS")


def memory(key: str) -> int:
    """Bytes: "VmRSS" is what is held now, "VmHWM" the peak since `reset_peak`."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split(f"{key}:")[1].split()[0])
