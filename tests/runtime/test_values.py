"""Answers compared by value."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.multiway.answers import Edge
from cfr_jax.networks.inputs import Cloud
from cfr_jax.runtime.values import ByValue


@dataclasses.dataclass(frozen=True, eq=False)
class Record(ByValue):
    _not_compared = ("seconds",)

    array: np.ndarray
    nested: dict
    number: float | None = 1.0
    seconds: float = 0.0


def record(**changed):
    given = {"array": np.array([1.0, np.nan]), "nested": {"a": (jnp.arange(3), [np.eye(2)])}}
    return Record(**(given | changed))


def test_records_with_equal_fields_are_equal_and_have_one_hash():
    first, second = record(), record(seconds=3.0)
    assert first == second and not first != second
    assert hash(first) == hash(second) and len({first, second}) == 1
    assert record(number=float("nan")) == record(number=float("nan"))


@pytest.mark.parametrize(
    "changed",
    [
        {"array": np.array([1.0, 2.0])},
        {"array": np.array([1.0])},
        {"nested": {"a": (jnp.arange(3), [2 * np.eye(2)])}},
        {"nested": {"a": (jnp.arange(3),)}},
        {"nested": {"b": 1}},
        {"number": None},
        {"number": 2.0},
    ],
)
def test_records_that_differ_in_one_field_are_not_equal(changed):
    assert (record() == record(**changed)) is False


def test_a_record_is_not_equal_to_anything_else():
    edge = Edge(0, 1, np.eye(4), None, True, 0.0, 0.0, "")
    assert (record() == 3) is False and (record() == edge) is False and (edge == None) is False  # noqa: E711


def test_clouds_of_the_network_compare_by_value():
    cloud = Cloud(jnp.ones((3, 3)), jnp.ones((3, 3)), jnp.zeros((3, 2), jnp.int32))
    assert cloud == cloud.replace(points=jnp.ones((3, 3)))
    assert cloud != cloud.replace(points=jnp.zeros((3, 3)))
    assert cloud != cloud.replace(mask=jnp.ones(3, bool))
