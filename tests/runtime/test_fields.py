"""The types of a dataclass's fields are checked against their values."""

from dataclasses import dataclass, field
from typing import Any

import pytest

from cfr_jax.runtime.fields import check_types


@dataclass
class Inner:
    pass


@dataclass
class Sample:
    count: int = 1
    rate: float = 0.5
    name: str = ""
    fast: bool = False
    threads: int | None = None
    keep: tuple[float, float] = (0.0, 1.0)
    options: dict[str, Any] = field(default_factory=dict)
    inner: Inner = field(default_factory=Inner)
    anything: object = None


def test_values_of_the_right_type_pass():
    check_types(Sample())
    check_types(Sample(rate=1, threads=2, anything=[3]))


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("count", 1.0, "s.count: got 1.0, wanted a whole number"),
        ("count", True, "s.count: got True, wanted a whole number"),
        ("rate", "1", "s.rate: got '1', wanted a number"),
        ("rate", False, "s.rate: got False, wanted a number"),
        ("name", None, "s.name: got None, wanted a text"),
        ("fast", 0, "s.fast: got 0, wanted True or False"),
        ("threads", "2", "s.threads: got '2', wanted a whole number or None"),
        ("keep", [0.0, 1.0], r"s.keep: got \[0.0, 1.0\], wanted a tuple"),
        ("options", (), r"s.options: got \(\), wanted a dict"),
        ("inner", {}, "s.inner: got {}, wanted Inner"),
    ],
)
def test_a_value_of_the_wrong_type_is_named(name, value, wanted):
    with pytest.raises(ValueError, match=f"^{wanted}$"):
        check_types(Sample(**{name: value}), "s.")
