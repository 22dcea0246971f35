"""Random weights of DCP, FMR and RGM under the names and in the layouts of their authors.

The published widths are the defaults; narrower ones keep all names. Norms and running statistics
differ from the identity, so that a mistake in any of them shows.
"""

import numpy as np

Array = np.ndarray


def random_dcp_state_dict(seed: int, *, version: int = 2, width: int = 512) -> dict[str, Array]:
    """DCP v1 (31 tensors) or v2 (77): counters and the constant reflection included."""
    draw = _Draw(seed)
    draw.edges("emb_nn", width)
    if version == 2:
        draw.transformer("pointer.model", width, 2 * width)
    draw.state["head.reflect"] = np.diag([1, 1, -1]).astype(np.float32)
    return draw.state


def random_fmr_state_dict(seed: int) -> dict[str, Array]:
    """FMR, decoder included; the steps of the finite differences differ from each other."""
    draw = _Draw(seed)
    draw.put("dt", draw.rng.uniform(0.005, 0.02, (1, 6)))
    stages = {
        "h1": (("0", 3, 64, "1"), ("3", 64, 64, "4")),
        "h2": (("0", 64, 64, "1"), ("3", 64, 128, "4"), ("6", 128, 1024, "7")),
    }
    for stage, layers in stages.items():
        for conv, inputs, outputs, norm in layers:
            draw.linear(f"encoder.{stage}.{conv}", inputs, outputs, rank=3)
            draw.batch_norm(f"encoder.{stage}.{norm}", outputs)
    for i, (inputs, outputs) in enumerate(((1024, 1024), (1024, 512), (512, 256)), 1):
        draw.linear(f"decoder.fc{i}", inputs, outputs)
        draw.batch_norm(f"decoder.bn{i}", outputs)
    draw.linear("decoder.fc4", 256, 3 * 2048)
    return draw.state


def random_rgm_state_dict(seed: int, *, width: int = 512) -> dict[str, Array]:
    """RGM with two layers."""
    draw = _Draw(seed)
    draw.edges("pointfeaturer", width)
    for i, inputs in enumerate((2 * width, width)):
        draw.transformer(f"gmattend{i}.model", inputs, 2 * width)
        for name in ("a_fc", "u_fc"):
            draw.linear(f"gnn_layer_{i}.gconv.{name}", inputs, width)
        reach = 1 / np.sqrt(width)
        draw.put(f"affinity_{i}.A", np.eye(width) + draw.rng.uniform(-reach, reach, (width,) * 2))
        draw.put(f"InstNorm_layer_{i}.weight", draw.rng.uniform(3, 5, 1))
        draw.put(f"InstNorm_layer_{i}.bias", draw.rng.uniform(-0.5, 0.5, 1))
    draw.linear("cross_graph_0", 2 * width, width)
    return draw.state


class _Draw:
    """A state dict being filled from one stream of random numbers."""

    def __init__(self, seed: int):
        self.rng = np.random.default_rng(seed)
        self.state: dict[str, Array] = {}

    def put(self, name: str, values: Array) -> None:
        self.state[name] = np.asarray(values, np.float32)

    def linear(
        self, name: str, inputs: int, outputs: int, *, rank: int = 2, bias: bool = True
    ) -> None:
        bound = 1 / np.sqrt(inputs)
        shape = (outputs, inputs) + (1,) * (rank - 2)
        self.put(f"{name}.weight", self.rng.uniform(-bound, bound, shape))
        if bias:
            self.put(f"{name}.bias", self.rng.uniform(-bound, bound, outputs))

    def batch_norm(self, name: str, channels: int) -> None:
        self.put(f"{name}.weight", self.rng.uniform(0.8, 1.2, channels))
        self.put(f"{name}.bias", self.rng.uniform(-0.1, 0.1, channels))
        self.put(f"{name}.running_mean", self.rng.uniform(-0.1, 0.1, channels))
        self.put(f"{name}.running_var", self.rng.uniform(0.05, 0.2, channels))
        self.state[f"{name}.num_batches_tracked"] = np.array(
            1000
        )  # torch has an array without axes, too

    def edges(self, prefix: str, width: int) -> None:
        widths = (6, width // 8, width // 8, width // 4, width // 2)
        for i, (inputs, outputs) in enumerate(zip(widths, widths[1:], strict=False), 1):
            self.linear(f"{prefix}.conv{i}", inputs, outputs, rank=4, bias=False)
            self.batch_norm(f"{prefix}.bn{i}", outputs)
        self.linear(f"{prefix}.conv5", width, width, rank=4, bias=False)
        self.batch_norm(f"{prefix}.bn5", width)

    def transformer(self, prefix: str, width: int, inner: int) -> None:
        for side, attentions in (
            ("encoder", ("self_attn",)),
            ("decoder", ("self_attn", "src_attn")),
        ):
            block = f"{prefix}.{side}.layers.0"
            for attention in attentions:
                for i in range(4):
                    self.linear(f"{block}.{attention}.linears.{i}", width, width)
            self.linear(f"{block}.feed_forward.w_1", width, inner)
            self.linear(f"{block}.feed_forward.w_2", inner, width)
            for i in range(len(attentions) + 1):
                self.point_norm(f"{block}.sublayer.{i}.norm", width)
            self.point_norm(f"{prefix}.{side}.norm", width)

    def point_norm(self, name: str, width: int) -> None:
        self.put(f"{name}.a_2", self.rng.uniform(0.8, 1.2, width))
        self.put(f"{name}.b_2", self.rng.uniform(-0.1, 0.1, width))
