"""The Rerun recording, read back by Rerun itself if it is installed."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.viewer import Scene, write_recording
from cfr_jax.viewer.camera import best_view


def make_scene(offset=0.0):
    rng = np.random.default_rng(0)
    transforms = np.tile(np.eye(4), (3, 1, 1))
    transforms[1:, :3, :3] = Rotation.random(2, rng=rng).as_matrix()
    source = rng.normal(size=(40, 3)) * [1.0, 2.0, 0.3] + offset
    target = rng.normal(size=(50, 3)) + offset
    # about the middle, so that the clouds stay where they are
    transforms[:, :3, 3] = target.mean(0) - transforms[:, :3, :3] @ source.mean(0)
    return Scene(source, target, transforms, ("start", "one", "refined"), facts={"fitness": "0.7"})


def test_without_rerun_the_message_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ModuleNotFoundError, match=r"cfr_jax\[rerun\]"):
        write_recording(tmp_path / "scene.rrd", make_scene())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_rerun_reads_every_station_where_the_transform_puts_the_source(tmp_path, offset):
    # given
    pytest.importorskip("rerun", reason="needs the rerun extra")
    chunk = pytest.importorskip("rerun.chunk", reason="reads recordings from rerun 0.40 on")
    scene = make_scene(offset)

    # when
    write_recording(tmp_path / "scene.rrd", scene)

    # then
    columns = {}
    for piece in chunk.RrdReader(str(tmp_path / "scene.rrd")).stream():
        batch = piece.to_record_batch()
        for name, values in zip(batch.schema.names, batch.columns, strict=True):
            columns[f"{piece.entity_path}:{name}"] = values.to_pylist()
    positions = {
        who: np.array(columns[f"/{who}:Points3D:positions"][0])
        for who in ("source/points", "target")
    }
    center = best_view(scene).center
    np.testing.assert_allclose(positions["target"], scene.target - center, atol=1e-5)
    matrices = np.array(columns["/source:Transform3D:mat3x3"]).reshape(3, 3, 3).swapaxes(1, 2)
    shifts = np.array(columns["/source:Transform3D:translation"]).reshape(3, 3)
    for k in range(3):
        shown = positions["source/points"] @ matrices[k].T + shifts[k]
        np.testing.assert_allclose(shown, scene.moved(k) - center, atol=1e-5)
    assert columns["/source:station"] == [0, 1, 2]
    assert "fitness: 0.7" in columns["/result:TextDocument:text"][0][0]
