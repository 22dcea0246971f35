import mesh_samples as samples
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.data.making.duplicates import drop_duplicates
from cfr_jax.data.making.shapes import (
    Unfit,
    clean_triangles,
    make_shape,
    name_share,
)
from cfr_jax.io.mesh import Mesh, sample_triangles

POINTS = 512


def shape_of(mesh, name="a"):
    return make_shape(mesh, name, POINTS)


def moved(mesh, matrix, shift=(0.0, 0.0, 0.0)):
    return Mesh(mesh.vertices @ np.asarray(matrix).T + shift, mesh.triangles, mesh.name)


def box(*sides):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * sides
    quads = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Mesh(corners.astype(float), triangles, "box")


def test_a_shape_is_centered_in_the_unit_sphere_with_unit_normals():
    shape = shape_of(moved(samples.knot(0), 40 * np.eye(3), (1e3, -5, 2)))
    np.testing.assert_allclose(shape.points.mean(axis=0), 0, atol=1e-6)
    assert np.linalg.norm(shape.points, axis=1).max() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=1), 1, atol=1e-6)


def test_points_fall_on_triangles_by_area_and_evenly_within():
    # One triangle has nine times the area of the other, in another plane.
    corners = np.array([[[0, 0, 0], [3, 0, 0], [0, 3, 0]], [[0, 0, 1], [1, 0, 1], [0, 1, 1.0]]])
    points, normals = sample_triangles(corners, 40_000, np.random.default_rng(0))
    large = points[:, 2] == 0
    assert large.mean() == pytest.approx(0.9, abs=0.01)
    np.testing.assert_allclose(points[large].mean(axis=0), [1, 1, 0], atol=0.02)
    # A quarter of a triangle lies less than halfway from its corner to the opposite edge.
    assert (points[large, :2].sum(axis=1) < 1.5).mean() == pytest.approx(0.25, abs=0.01)
    np.testing.assert_array_equal(normals, np.broadcast_to([0.0, 0.0, 1.0], normals.shape))


def test_the_name_alone_seeds_the_points():
    mesh = samples.knot(0)
    np.testing.assert_array_equal(shape_of(mesh, "a").points, shape_of(mesh, "a").points)
    assert not np.array_equal(shape_of(mesh, "a").points, shape_of(mesh, "b").points)


def test_shares_of_names_are_uniform_and_differ_by_purpose():
    shares = np.array([name_share(f"shape {i}", "split") for i in range(2000)])
    np.testing.assert_allclose(np.quantile(shares, [0.1, 0.5, 0.9]), [0.1, 0.5, 0.9], atol=0.04)
    others = [name_share(f"shape {i}", "order") for i in range(2000)]
    assert abs(np.corrcoef(shares, others)[0, 1]) < 0.1
    # These must never change, because the splits of published corpora depend on them.
    assert name_share("0ad:gaia/oak1", "split") == pytest.approx(0.16404, abs=1e-5)


def test_faces_without_area_or_with_broken_vertices_are_dropped():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [np.nan, 0, 0]])
    triangles = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2], [0, 1, 4]])
    kept = clean_triangles(Mesh(vertices, triangles, "mixed"))
    np.testing.assert_array_equal(kept, vertices[[[0, 1, 2]]])


@pytest.mark.parametrize(
    "mesh, reason",
    [
        (Mesh(np.zeros((0, 3)), np.zeros((0, 3), int), "none"), "no faces"),
        (Mesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "nan"), "no faces"),
        (Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), "point"), "no extent"),
        (Mesh(np.eye(3), np.array([[0, 1, 3]]), "index"), "names a vertex"),
        (box(1, 1, 1), "fewer than 20 faces"),
        (moved(samples.knot(0), np.diag([1, 1, 0.01])), "flat"),
        (
            moved(samples.knot(0), Rotation.from_euler("x", 40, degrees=True).as_matrix()
                  @ np.diag([1, 1, 0.01])),
            "flat",
        ),
    ],
)  # fmt: skip
def test_a_mesh_that_is_not_fit_is_refused_with_the_reason(mesh, reason):
    with pytest.raises(Unfit, match=reason):
        shape_of(mesh)


def test_a_shape_with_a_far_outlier_is_left_out():
    knot = samples.knot(0)
    speck = moved(samples.knot(1), 0.01 * np.eye(3), (30, 0, 0))
    far = Mesh(
        np.vstack([knot.vertices * [1, 4, 4], speck.vertices]),
        np.vstack([knot.triangles, speck.triangles + len(knot.vertices)]),
        "far",
    )
    # Enough of the surface lies far away that a sample hits it.
    far.vertices[len(knot.vertices) :, 1:] *= 100
    with pytest.raises(Unfit, match="concentrated"):
        shape_of(far)


def test_the_spacing_is_what_two_samples_of_one_mesh_have():
    shape = make_shape(samples.knot(0), "a", 2000)
    # For uniform points of density r on a surface, the mean nearest distance is 1 / (2 sqrt r).
    knot = clean_triangles(samples.knot(0))
    edges = np.cross(knot[:, 1] - knot[:, 0], knot[:, 2] - knot[:, 0])
    area = np.linalg.norm(edges, axis=1).sum() / 2
    surface, _ = sample_triangles(knot, 50_000, np.random.default_rng(0))
    radius = np.linalg.norm(surface - surface.mean(axis=0), axis=1).max()
    assert shape.spacing == pytest.approx(0.5 / np.sqrt(2000 / (area / radius**2)), rel=0.08)


MIRROR = np.diag([1.0, 1.0, -1.0])
TURN = Rotation.from_euler("xyz", [50, -20, 130], degrees=True).as_matrix()


@pytest.mark.parametrize("change", [np.eye(3), 7 * np.eye(3), MIRROR, TURN, MIRROR @ TURN])
def test_a_repeated_shape_is_dropped_in_any_pose(change):
    again = moved(samples.knot(0), change, (5, 0, 1))
    shapes = [shape_of(samples.knot(0)), shape_of(samples.knot(1)), shape_of(again, "again")]
    assert drop_duplicates(shapes, [True] * 3) == {2: 0}


def test_the_same_vertices_are_a_duplicate_even_if_samples_differ():
    knot = samples.knot(0)
    inside = np.unique(knot.triangles)[[0, 7, 14]]
    with_more_faces = Mesh(knot.vertices, np.vstack([knot.triangles, [inside] * 30]), "more")
    shapes = [shape_of(knot), shape_of(with_more_faces, "b")]
    assert shapes[0].fingerprint == shapes[1].fingerprint
    assert drop_duplicates(shapes, [True, True]) == {1: 0}


def test_an_unseen_shape_never_displaces_a_seen_one():
    shapes = [shape_of(samples.knot(0), name) for name in "ab"]
    assert drop_duplicates(shapes, [False, True]) == {0: 1}
    assert drop_duplicates(shapes, [True, False]) == {1: 0}
    assert drop_duplicates(shapes, [False, False]) == {1: 0}


def test_the_limit_is_wider_across_halves():
    # Between 1.2 and 1.3 times the spacing apart.
    base = samples.knot(0)
    for stretch in np.linspace(1.02, 1.2, 40):
        near = moved(base, np.diag([stretch, 1, 1]))
        shapes = [shape_of(base, "a"), shape_of(near, "b")]
        if not drop_duplicates(shapes, [True, True]):
            break
    assert drop_duplicates(shapes, [True, False]) == {1: 0}


def test_distinct_shapes_all_stay():
    shapes = [shape_of(samples.knot(seed), str(seed)) for seed in range(12)]
    assert drop_duplicates(shapes, [True] * 12) == {}
    assert drop_duplicates([], []) == {}
