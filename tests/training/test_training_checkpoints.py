"""Checkpoints: whole or not there; any damage is found, named, and gone around."""

import json
import os
import resource
import shutil
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.runtime import manifest
from cfr_jax.training.checkpoints import Checkpoints, SaveError
from cfr_jax.training.step import TrainState


def state_at(step):
    rng = np.random.default_rng(step)
    params = {"kernel": jnp.asarray(rng.normal(size=(40, 40)), jnp.float32)}
    return TrainState(
        step=jnp.asarray(step, jnp.int32),
        params=params,
        average=params,
        optimizer=(jnp.zeros(3),),
        skipped=jnp.zeros((), jnp.int32),
        skipped_in_row=jnp.zeros((), jnp.int32),
    )


def save(folder, *steps, keep=5, best=None):
    with Checkpoints(folder, keep) as checkpoints:
        for step in steps:
            checkpoints.save(state_at(step), {"step": step}, best)


def restore(folder):
    with Checkpoints(folder, 5) as checkpoints:
        return checkpoints.restore(state_at(0))


def assert_is(restored, step):
    state, about = restored
    assert about == {"step": step} and int(state.step) == step
    np.testing.assert_array_equal(state.params["kernel"], state_at(step).params["kernel"])


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved")
    save(folder, 1, 2)
    return folder


@pytest.fixture
def folder(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "checkpoints")


def files_of(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_what_was_saved_comes_back(folder):
    assert_is(restore(folder), 2)


def test_a_new_folder_has_nothing_to_restore(tmp_path):
    assert restore(tmp_path / "new") is None


def test_the_last_ones_and_the_best_are_kept(tmp_path):
    save(tmp_path, 1, 2, 3, 4, 5, keep=2, best=2)

    assert Checkpoints(tmp_path, 2).steps() == [2, 4, 5]


def test_what_is_saved_is_the_state_at_that_moment_though_steps_go_on(tmp_path):
    import jax

    forward = jax.jit(
        lambda state: state.replace(params={"kernel": state.params["kernel"] + 1}),
        donate_argnums=0,
    )
    with Checkpoints(tmp_path, 2) as checkpoints:
        state = state_at(3).replace(average={})
        checkpoints.save(state, {"step": 3})
        for _ in range(50):
            state = forward(state)
        checkpoints.wait()
        restored, _ = checkpoints.restore(state_at(0).replace(average={}))

    np.testing.assert_array_equal(restored.params["kernel"], state_at(3).params["kernel"])


def test_every_one_of_500_flipped_bits_is_found_and_named(folder):
    rng = np.random.default_rng(0)
    newest, whole = folder / "2", []
    for path in files_of(newest):
        whole += [path] * max(1, path.stat().st_size)
    manifest.verify(newest)

    for number in rng.integers(len(whole), size=500):
        path = whole[number]
        content = path.read_bytes()
        if content:
            at, bit = rng.integers(len(content)), rng.integers(8)
            flipped = bytearray(content)
            flipped[at] ^= 1 << bit
            path.write_bytes(flipped)

            with pytest.raises(manifest.Damaged, match=path.name):
                manifest.verify(newest)

            path.write_bytes(content)
    manifest.verify(newest)


def test_every_file_lost_or_cut_short_is_found_and_named(folder):
    newest = folder / "2"
    for path in files_of(newest):
        content = path.read_bytes()
        path.unlink()
        with pytest.raises(manifest.Damaged, match=path.name):
            manifest.verify(newest)
        if content:
            path.write_bytes(content[: len(content) // 2])
            with pytest.raises(manifest.Damaged, match=path.name):
                manifest.verify(newest)
        path.write_bytes(content)
    manifest.verify(newest)


def test_every_bit_of_a_manifest_counts(folder):
    path = folder / "2" / manifest.NAME
    content = path.read_bytes()
    for at in range(0, len(content), 61):
        for bit in range(8):
            path.write_bytes(content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :])
            with pytest.raises(manifest.Damaged):
                manifest.verify(folder / "2")


def test_a_file_that_does_not_belong_there_is_named(folder):
    (folder / "2" / "state" / "stray").write_text("")

    with pytest.raises(manifest.Damaged, match="stray does not belong"):
        manifest.verify(folder / "2")


@pytest.mark.parametrize("way", ["flip", "cut", "delete", "no manifest"])
def test_the_newest_sound_one_is_used_instead_of_a_damaged_one(folder, way):
    path = max(files_of(folder / "2" / "state"), key=lambda path: path.stat().st_size)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 16
    if way == "flip":
        path.write_bytes(content)
    elif way == "cut":
        path.write_bytes(content[:-1])
    elif way == "delete":
        path.unlink()
    else:
        path = folder / "2" / manifest.NAME
        path.unlink()

    with pytest.warns(UserWarning, match=f"{path.name}.*going back to the checkpoint before it"):
        assert_is(restore(folder), 1)

    assert (folder / "2.damaged").is_dir()
    assert_is(restore(folder), 1)  # without a word from now on
    save(folder, 2)
    assert_is(restore(folder), 2)


def test_when_all_are_damaged_nothing_starts_anew_in_silence(folder):
    for step in "12":
        (folder / step / "about.json").write_text("{}")

    for _ in range(2):  # the second time they have other names
        with (
            pytest.raises(ValueError, match="no sound checkpoint in .*2 are damaged; remove the"),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            restore(folder)


def test_a_checkpoint_of_another_network_is_told(folder):
    other = state_at(0).replace(params={"other": jnp.zeros(2)}, average={"other": jnp.zeros(2)})

    with (
        Checkpoints(folder, 5) as checkpoints,
        pytest.raises(ValueError, match="a different training.*about.json"),
    ):
        checkpoints.restore(other)


def test_a_save_that_was_cut_off_leaves_no_checkpoint(folder):
    # given what a kill while orbax writes leaves behind
    (folder / ".unfinished" / "3" / "state").mkdir(parents=True)
    (folder / ".unfinished" / "3" / "state" / "d").write_text("half")

    assert_is(restore(folder), 2)
    assert not (folder / ".unfinished" / "3").exists()


@pytest.fixture
def small_files():
    """The system refuses files beyond a kilobyte, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def limit(size=1024):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))

    yield limit
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


# orbax leaves the futures of what it could not write unread
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_disk_that_takes_no_more_is_told_and_the_last_good_one_stays(folder, small_files):
    small_files()
    with pytest.raises(SaveError, match="step 3 .*last good one is at step 2") as stopped:
        save(folder, 3)
    small_files(resource.RLIM_INFINITY)

    assert "same command again" in str(stopped.value)
    assert len(str(stopped.value).splitlines()) <= 3
    assert_is(restore(folder), 2)
    assert sorted(path.name for path in folder.iterdir() if path.name != ".unfinished") == [
        "1",
        "2",
    ]
    save(folder, 3)
    assert_is(restore(folder), 3)


def test_an_unwritable_folder_is_told_and_the_last_good_one_stays(folder):
    # root may write where others may not: here something is in the way
    shutil.rmtree(folder / ".unfinished", ignore_errors=True)
    (folder / ".unfinished").write_text("a file")

    with pytest.raises(SaveError, match="step 3 .*could not be written; .*good one is at step 2"):
        save(folder, 3)

    assert_is(restore(folder), 2)


def test_a_file_where_the_folder_should_be_is_told(tmp_path):
    (tmp_path / "checkpoints").write_text("a file")

    with pytest.raises(OSError, match="checkpoints"):
        save(tmp_path / "checkpoints", 1)


def test_what_is_said_of_a_state_can_be_read_by_people(folder):
    assert json.loads((folder / "2" / "about.json").read_text()) == {"step": 2}


@pytest.mark.parametrize("kind", ["pipe", "device", "kernel", "dangling link", "link to a folder"])
def test_whatever_is_no_file_among_a_checkpoint_is_damage_and_named(folder, kind):
    """Each file is replaced by it, the manifest, too; and it is put beside them."""
    newest = folder / "2"
    kept = {path: path.read_bytes() for path in files_of(newest)}
    for path in (*kept, newest / manifest.NAME, newest / "state" / "new"):
        # given
        content = path.read_bytes() if path.exists() else None
        path.unlink(missing_ok=True)
        places = {"device": "/dev/zero", "kernel": "/proc/self/status", "dangling link": "nowhere"}
        if kind == "pipe":
            os.mkfifo(path)
        else:
            path.symlink_to(places.get(kind, folder))

        # when, then
        with pytest.raises(manifest.Damaged, match=path.name):
            manifest.verify(newest)
        path.unlink()
        if content is not None:
            path.write_bytes(content)
    manifest.verify(newest)
