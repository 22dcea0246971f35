"""Compares the refinement from the network's answer with the refinement from the truth.

    python -m benchmarks.refinement --corpus data/open_cad/val.h5 --pairs 60

The pairs are those of the partial protocol, with exact normals. `refine` starts at the network's
answer. From the truth only its descent runs, because `refine` would keep a start that scores
better. The script prints the errors of both, over the pairs whose start lies in the basin of
convergence: within 15 degrees and 0.3 radii.
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import numpy as np
import tqdm

from cfr_jax.alignment import solving
from cfr_jax.alignment.align import align
from cfr_jax.alignment.planning import planned
from cfr_jax.cli.shared.cache import keep_compiled_programs
from cfr_jax.data.corpus import read_corpus
from cfr_jax.data.protocol import fixed_pair, partial
from cfr_jax.evaluation import metrics
from cfr_jax.refine import generalized_icp

_BASIN = 15.0, 0.3


@jax.jit
def _ends(source, target, network, truth):
    surfaces = [solving.surface(cloud.prepared()) for cloud in (source, target)]
    return {
        "network": generalized_icp.refine(*surfaces, network).transform,
        "truth": generalized_icp.descend(*surfaces, truth)[0],
    }


def main() -> None:
    """Refines from both starts, and prints the errors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--corpus", required=True, help="HDF5 file of shapes")
    parser.add_argument("--pairs", type=int, default=60)
    args = parser.parse_args()
    keep_compiled_programs()
    corpus = read_corpus(args.corpus)
    truths, starts, ends = [], [], {"network": [], "truth": []}
    # spread evenly over the corpus
    for index in tqdm.tqdm(np.linspace(0, len(corpus) - 1, args.pairs).astype(int)):
        pair = fixed_pair(corpus, int(index), partial)
        clouds = (
            np.hstack([pair.source, pair.source_normals]),
            np.hstack([pair.target, pair.target_normals]),
        )
        truth = pair.transform.astype(float)
        start = align(*clouds, refine=False).transform
        plan = planned(*clouds)
        sides = solving.on_device(plan.source, plan.target)
        unit = [jnp.asarray(plan.frames.to_unit(m), jnp.float32) for m in (start, truth)]
        for name, motion in _ends(*sides, *unit).items():
            ends[name].append(plan.frames.to_caller(np.asarray(motion)))
        truths.append(truth)
        starts.append(start)
    truths, starts = np.stack(truths), np.stack(starts)
    inside = metrics.recalled(metrics.err_r(starts, truths), metrics.err_t(starts, truths), *_BASIN)
    print(f"{inside.sum()} of {len(inside)} starts in the basin")
    for name, motions in ends.items():
        turn, slide = (
            metrics.err_r(np.stack(motions), truths),
            metrics.err_t(np.stack(motions), truths),
        )
        of = [f(errors[inside]) for f in (np.mean, np.median) for errors in (turn, slide)]
        print("from the {}: mean {:.3f}°, {:.4f}; median {:.3f}°, {:.4f}".format(name, *of))


if __name__ == "__main__":
    main()
