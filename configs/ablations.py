"""Short trainings of the paper's network and of variants: --config=configs/ablations.py:shared

To change the number of steps, append it: --config=configs/ablations.py:shared,3000. Data, loss and
optimizer are those of `open_cad.py`. Every variant takes the same number of steps on small clouds.
That is a fraction of what a good model needs, and just enough to tell the variants apart.
`ablate.py` runs them and compares them at full size.
"""

from typing import Any

from cfr_jax.training.config import Phase, SamplingSection, TrainingConfig

STEPS = 1000
# What each variant changes: settings of the network, or one light layer for all iterations.
VARIANTS: dict[str, dict[str, Any]] = {
    "cfr": {},
    "shared": {"shared": True},
    "constant_passes": {"settings": {"passes": 5}},
    "annealing_each": {"settings": {"repeat_annealing": True}},
    "extraction_each": {"settings": {"repeat_extraction": True}},
}


def get_config(chosen: str = "cfr") -> TrainingConfig:
    """The training of a variant; `chosen` is its name, optionally followed by a number of steps."""
    variant, _, steps = chosen.partition(",")
    return TrainingConfig(
        phases=(Phase(steps=int(steps or STEPS), points=256, neighbors=24, batch=8),),
        # rotated one way, as in the protocol, and about the shape's middle: the recipe at the time
        # of these runs
        sampling=SamplingSection(both_ways=0.0, near=0.0, centered=0.0),
        validation_pairs=93,
        **VARIANTS[variant],
    )
