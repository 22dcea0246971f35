"""Short trainings of the paper's network and of variants: --config=configs/ablations.py:shared

Another number of steps is written behind: --config=configs/ablations.py:shared,3000. Data, loss and
optimizer are those of `open_cad.py`. Every variant takes the same number of steps, a fraction of
what a good model wants, on small clouds: enough to tell them apart, and no more. `ablate.py` runs
them, and compares them at full size.
"""

from typing import Any

from cfr_jax.training.config import Phase, SamplingSection, TrainingConfig

STEPS = 1000
# What a variant does otherwise: settings of the network, or one light layer for all iterations.
VARIANTS: dict[str, dict[str, Any]] = {
    "cfr": {},
    "shared": {"shared": True},
    "constant_passes": {"settings": {"passes": 5}},
    "annealing_each": {"settings": {"repeat_annealing": True}},
    "extraction_each": {"settings": {"repeat_extraction": True}},
}


def get_config(chosen: str = "cfr") -> TrainingConfig:
    """A variant, and perhaps how many steps it takes."""
    variant, _, steps = chosen.partition(",")
    return TrainingConfig(
        phases=(Phase(steps=int(steps or STEPS), points=256, neighbors=24, batch=8),),
        # turned as the protocol has it and about the shape's middle, as the recipe was when these
        # ran
        sampling=SamplingSection(both_ways=0.0, near=0.0, centered=0.0),
        validation_pairs=93,
        **VARIANTS[variant],
    )
