"""The training loop: batches in, checkpoints, measurements and weights out."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Hashable
from pathlib import Path

import jax
import ml_collections
import numpy as np
import tqdm

from cfr_jax import __version__, metrics, network, registration, rpmnet, training, weights
from cfr_jax.checkpoints import Checkpoints
from cfr_jax.data import protocol
from cfr_jax.data.batches import Sampling, batches
from cfr_jax.data.corpus import Corpus, read_corpus
from cfr_jax.neighbors import nearest_on_host


@dataclasses.dataclass(frozen=True)
class Phase:
    """A stretch of the curriculum."""

    steps: int
    points: int
    neighbors: int
    batch: int


@dataclasses.dataclass(frozen=True)
class Learner:
    """A network that can be trained, and how it is run in training and when it is validated."""

    fresh: Callable[[jax.Array], dict]
    unroll: training.Unroll
    trained: Callable[[int], Hashable]
    """Settings by the number of neighbors."""
    validated: Hashable


def learner(config: ml_collections.ConfigDict) -> Learner:
    """The network that `config.network` names: "cfr", or "rpmnet" to compare with."""
    if config.network == "cfr":
        changed = dict(config.get("settings", {}))
        return Learner(
            fresh=lambda key: network.init_params(
                key, config.iterations, config.get("shared", False)
            ),
            unroll=registration.unroll,
            trained=lambda count: registration.Settings(
                neighbors=count, detach_motion=True, **changed
            ),
            validated=registration.Settings(**changed),
        )
    if config.network == "rpmnet":
        return Learner(
            fresh=rpmnet.init_params,
            unroll=rpmnet.unroll,
            trained=lambda count: rpmnet.Settings(neighbors=count, iterations=config.iterations),
            validated=rpmnet.Settings(),
        )
    raise ValueError(f"network: got {config.network!r}, wanted 'cfr' or 'rpmnet'")


def run(config: ml_collections.ConfigDict, workdir: Path) -> dict:
    """Trains by `config` in `workdir`, going on where a checkpoint there left off.

    Writes `checkpoints/`, `metrics.jsonl` (a line each time something is measured), and
    `weights.safetensors` (the averaged weights of the best validation so far). Returns the best
    validation.
    """
    chosen = learner(config)
    workdir.mkdir(parents=True, exist_ok=True)
    corpus = read_corpus(config.data.train)
    held_out = validation_batch(read_corpus(config.data.validation), config.validation_pairs)
    phases = [Phase(**phase) for phase in config.phases]
    total = sum(phase.steps for phase in phases)
    optimizer = training.make_optimizer(
        peak_rate=config.train.peak_rate,
        steps=total,
        warmup=config.train.warmup,
        clip=config.train.clip,
        weight_decay=config.train.weight_decay,
    )
    params = chosen.fresh(jax.random.key(config.seed))
    if config.train.start_from:
        params = weights.load_params(config.train.start_from, config.network)
    state = training.init_state(params, optimizer)
    best: dict = {}
    with Checkpoints(workdir / "checkpoints", keep=config.keep_checkpoints) as checkpoints:
        restored = checkpoints.restore(state)
        if restored is not None:
            state, about = restored
            best = about["best"]
        log = Log(workdir / "metrics.jsonl", total, int(state.step))
        for phase, done in remaining(phases, int(state.step)):
            sampling = Sampling(
                points=phase.points, neighbors=phase.neighbors, **config.sampling.to_dict()
            )
            stream = batches(
                corpus,
                sampling,
                size=phase.batch,
                position=pairs_before(phases, int(state.step)),
                count=phase.steps - done,
                seed=config.seed,
                workers=config.train.workers,
            )
            for batch in stream:
                state, measured = training.train_step(
                    state,
                    batch,
                    unroll=chosen.unroll,
                    settings=chosen.trained(phase.neighbors),
                    optimizer=optimizer,
                    correspondence_weight=config.train.correspondence_weight,
                    decay=config.train.average_decay,
                    pairs_at_once=config.train.pairs_at_once,
                )
                step = int(state.step)
                log.training(step, measured)
                if step % config.log_every == 0:
                    log.write(step, skipped=int(state.skipped))
                if step % config.validate_every == 0 or step == total:
                    found = validate(chosen, state.average, held_out)
                    log.validation(step, found)
                    if found["rotation_mean"] < best.get("rotation_mean", np.inf):
                        best = {"step": step, **found}
                        weights.save_params(
                            workdir / "weights.safetensors",
                            state.average,
                            training_notes(config, best),
                        )
                    checkpoints.save(state, {"best": best, "config": config.to_dict()})
        log.close()
    return best


def remaining(phases: list[Phase], step: int):
    """The phases that `step` has not finished, each with the number of its steps already done."""
    for phase in phases:
        if step < phase.steps:
            yield phase, step
        step = max(0, step - phase.steps)


def pairs_before(phases: list[Phase], step: int) -> int:
    """How many pairs of the stream `step` steps have used."""
    used = 0
    for phase in phases:
        taken = min(step, phase.steps)
        used, step = used + taken * phase.batch, step - taken
    return used


def validation_batch(corpus: Corpus, count: int) -> dict:
    """The first pairs of the fixed partial protocol, spread over the corpus, as one batch."""
    settings = registration.Settings()
    chosen = np.linspace(0, len(corpus) - 1, min(count, len(corpus))).astype(int)
    pairs = [protocol.fixed_pair(corpus, int(index), protocol.partial) for index in chosen]
    batch = {
        "transform": np.stack([pair.transform for pair in pairs]),
        "estimate_normals": np.zeros(len(pairs), bool),
    }
    for side in ("source", "target"):
        clouds = [getattr(pair, side) for pair in pairs]
        batch[side] = np.stack(clouds)
        batch[f"{side}_normals"] = np.stack([getattr(pair, f"{side}_normals") for pair in pairs])
        batch[f"{side}_neighbors"] = np.stack(
            [nearest_on_host(c, settings.neighbors, radius=settings.radius) for c in clouds]
        )
    return batch


def validate(chosen: Learner, params: dict, batch: dict) -> dict:
    """Errors of the network alone on held-out pairs, at full size."""
    transforms = training.predict(params, batch, unroll=chosen.unroll, settings=chosen.validated)
    transforms = np.asarray(transforms, np.float64)
    truth = batch["transform"].astype(np.float64)
    rotation = metrics.err_r(transforms[:, -1], truth)
    translation = metrics.err_t(transforms[:, -1], truth)
    return {
        "rotation_mean": float(rotation.mean()),
        "rotation_median": float(np.median(rotation)),
        "translation_mean": float(translation.mean()),
        "recall_5deg_0.1": float(metrics.recalled(rotation, translation, 5.0, 0.1).mean()),
        "rotation_by_iteration": [
            float(metrics.err_r(transforms[:, i], truth).mean()) for i in range(transforms.shape[1])
        ],
    }


def training_notes(config, best) -> dict[str, str]:
    """What the weights file says of its own making."""
    return {
        "config": json.dumps(config.to_dict(), sort_keys=True),
        "validation": json.dumps(best),
        "made_by": f"cfr_jax {__version__} train.py",
    }


class Log:
    """A progress bar for people, `metrics.jsonl` for programs; measurements stay on the device
    until they are written."""

    def __init__(self, path: Path, total: int, step: int):
        self._path, self._waiting, self._since = path, [], time.perf_counter()
        self._used, self._mark = 0.0, time.process_time()
        self._bar = tqdm.tqdm(total=total, initial=step, unit="step", mininterval=5)

    def training(self, step: int, measured) -> None:
        """Takes note of one step."""
        self._waiting.append(measured)
        self._bar.update(step - self._bar.n)

    def write(self, step: int, skipped: int) -> None:
        """Writes the mean of the steps since the last call."""
        mean = jax.tree.map(lambda *leaves: np.mean(np.stack(leaves), axis=0), *self._waiting)
        now, used = time.perf_counter(), time.process_time()
        self._used, self._mark = self._used + used - self._mark, used
        line = {
            "step": step,
            "loss": float(mean.total),
            "pose": float(mean.pose),
            "correspondence": float(mean.correspondence),
            "rotation_error": mean.rotation_error.tolist(),
            "translation_error": mean.translation_error.tolist(),
            "beta": mean.beta.tolist(),
            "alpha": mean.alpha.tolist(),
            "steps_per_second": len(self._waiting) / (now - self._since),
            # of all threads, since this process started, without validations
            "processor_seconds": self._used,
            "skipped": skipped,
        }
        self._waiting, self._since = [], now
        self._append(line)
        self._bar.set_postfix(
            loss=f"{line['loss']:.3f}", RE=f"{line['rotation_error'][-1]:.1f}", refresh=False
        )

    def validation(self, step: int, found: dict) -> None:
        """Writes a validation."""
        self._append({"step": step, "validation": found})
        tqdm.tqdm.write(
            f"step {step}: validation RE {found['rotation_mean']:.2f} mean, "
            f"{found['rotation_median']:.2f} median, recall {found['recall_5deg_0.1']:.2f}"
        )
        self._since, self._mark = time.perf_counter(), time.process_time()

    def _append(self, line: dict) -> None:
        with self._path.open("a") as file:
            file.write(json.dumps(line) + "\n")

    def close(self) -> None:
        """Ends the bar."""
        self._bar.close()
