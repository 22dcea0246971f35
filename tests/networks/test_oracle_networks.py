"""The networks of the oracle: known answers and invariances of whole registrations."""

import numpy as np
import pytest
from oracle import authors, cfr, clouds, measures, pieces, rpmnet
from oracle.network import annealing
from scipy.spatial.transform import Rotation

MODELS = {
    "cfr": (cfr, authors.random_state_dict),
    "rpmnet": (rpmnet, authors.random_rpmnet_state_dict),
}
SETTINGS = {"neighbors": 20, "radius": 0.3}


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def pair():
    return clouds.random_pair(seed=3, n=90, m=80)


@pytest.fixture(params=MODELS)
def model(request):
    module, random_weights = MODELS[request.param]
    return module, random_weights(seed=1)


def ignore_positions(state):
    for name, tensor in state.items():
        if ".nets_b." in name:
            tensor[...] = 0  # in CFR positions enter here alone
        if name == "feat_extractor.prepool.0.weight":
            tensor[:, :3] = 0  # in RPM-Net they are the first three channels


def match_equal_features_only(state):
    state["weights_net.postpool.6.weight"][...] = 0
    beta, alpha = np.split(state["weights_net.postpool.6.bias"], 2)  # views
    beta[...], alpha[...] = 1e6, np.log(np.expm1(1e-5))


@pytest.mark.parametrize("name, tensors, numbers", [("cfr", 67, 880_906), ("rpmnet", 52, 905_154)])
def test_random_weights_have_the_size_of_the_published_networks(name, tensors, numbers):
    state = MODELS[name][1](seed=0)

    assert len(state) == tensors
    assert sum(tensor.size for tensor in state.values()) == numbers
    assert {tensor.dtype for tensor in state.values()} == {np.dtype(np.float32)}


def test_convolutions_answer_alike_in_both_stored_layouts(pair):
    for module, random_weights in MODELS.values():
        rank3, rank4 = (random_weights(seed=1, conv_rank=rank) for rank in (3, 4))
        assert {tensor.ndim for tensor in rank4.values()} == {1, 2, 4}
        first, second = (module.register(s, *pair[:4], **SETTINGS) for s in (rank3, rank4))
        np.testing.assert_array_equal(first, second)


def test_random_weights_give_answers_in_which_a_mistake_would_show(model):
    module, state = model
    pair = clouds.random_pair(seed=5, n=120, m=110)

    result = module.trace(state, *pair[:4], **SETTINGS)

    np.testing.assert_allclose(np.linalg.det(result.transforms[:, :3, :3]), 1)
    assert measures.err_r(result.transforms, np.eye(4)[None].repeat(5, 0)).min() > 2
    assert measures.err_r(result.transforms[1:], result.transforms[:-1]).min() > 0.1
    assert 0.05 < result.weights.min() and result.weights.max() < 0.97
    likeliest = np.median((result.matches / result.weights[..., None]).max(axis=2), axis=1)
    assert (likeliest > 1.5 / 110).all() and (likeliest < 0.9).all()


def test_the_order_of_points_changes_no_transform(model, pair, rng):
    module, state = model
    x, y, nx, ny, _ = pair
    px, py = rng.permutation(len(x)), rng.permutation(len(y))
    # 64 are more than any ball here holds; fewer would be chosen by index in RPM-Net
    settings = {"neighbors": 64, "radius": 0.3}
    assert pieces.ball_query(x, 0.3, 90)[:, 63:].std(axis=1).max() == 0

    plain = module.trace(state, x, y, nx, ny, **settings)
    shuffled = module.trace(state, x[px], y[py], nx[px], ny[py], **settings)

    np.testing.assert_allclose(shuffled.transforms, plain.transforms, atol=1e-9)
    np.testing.assert_allclose(shuffled.weights, plain.weights[:, px], atol=1e-9)


def test_a_shifted_copy_is_found_when_features_ignore_position(model, pair):
    module, state = model
    ignore_positions(state)
    match_equal_features_only(state)
    truth = pieces.rigid(np.eye(3), np.array([0.3, -0.2, 0.1]))
    x = pair.x.astype(np.float64)

    transforms = module.register(state, x, pieces.move(truth, x), pair.nx, pair.nx, **SETTINGS)

    np.testing.assert_allclose(transforms, np.broadcast_to(truth, (5, 4, 4)), atol=1e-4)


def test_any_rigid_copy_is_found_when_features_are_those_of_point_pairs(model, pair, rng):
    module, state = model
    ignore_positions(state)
    for name, tensor in state.items():
        if name.startswith("feat_extractor") and name.endswith("prepool.0.weight"):
            tensor[:, :-4] = 0  # the offsets, too
    match_equal_features_only(state)
    truth = pieces.rigid(Rotation.random(None, rng).as_matrix(), rng.normal(size=3))
    x, nx = pair.x.astype(np.float64), pair.nx.astype(np.float64)
    y, ny = pieces.move(truth, x), nx @ truth[:3, :3].T

    transforms = module.register(state, x, y, nx, ny, **SETTINGS)

    np.testing.assert_allclose(transforms, np.broadcast_to(truth, (5, 4, 4)), atol=1e-4)


def test_reference_features_depend_on_the_reference_alone(model, pair):
    module, state = model
    x, y, nx, ny, _ = pair

    one = module.trace(state, x, y, nx, ny, **SETTINGS)
    other = module.trace(state, x[:60] * 0.9, y, nx[:60], ny, **SETTINGS)

    np.testing.assert_array_equal(one.target_features, other.target_features)
    assert not np.allclose(one.transforms, other.transforms, atol=1e-2)


def test_fewer_iterations_are_the_first_ones_of_more(model, pair):
    module, state = model

    three = module.register(state, *pair[:4], iterations=3, **SETTINGS)

    np.testing.assert_array_equal(three, module.register(state, *pair[:4], **SETTINGS)[:3])


@pytest.mark.parametrize("name, passes", [("cfr", [1, 2, 3, 4, 5]), ("rpmnet", [5] * 5)])
def test_matches_are_the_published_number_of_sinkhorn_passes(name, passes, pair):
    module, random_weights = MODELS[name]

    result = module.trace(random_weights(seed=1), *pair[:4], **SETTINGS)

    for log_affinity, match, count in zip(
        result.log_affinities, result.matches, passes, strict=True
    ):
        expected = pieces.sinkhorn_scaling(np.exp(log_affinity), count)
        np.testing.assert_allclose(match, expected, rtol=1e-9)
    np.testing.assert_allclose(result.weights, result.matches.sum(axis=2))


@pytest.mark.parametrize("layer", ["nets_a.2.0.weight", "nets_a.2.2.bias", "nets_b.2.0.weight"])
def test_each_iteration_of_the_cascade_has_weights_of_its_own(layer, pair):
    state = authors.random_state_dict(seed=1)
    before = cfr.register(state, *pair[:4], **SETTINGS)

    state[f"feat_extractor_xyz.{layer}"][...] *= -1
    after = cfr.register(state, *pair[:4], **SETTINGS)

    changes = np.abs(after - before).max(axis=(1, 2))
    assert changes[:2].max() == 0 and changes[2:].min() > 1e-4


def test_the_flag_of_the_annealing_network_marks_the_target(pair):
    state, shift = authors.random_state_dict(seed=1), np.array([0.25, -0.5, 0.125])
    flagged, unflagged = dict(state), dict(state)
    first = "weights_net.prepool.0.weight"
    weight = state[first].astype(np.float64)
    flagged[first], unflagged[first] = weight.copy(), weight.copy()
    flagged[first][:, 3, 0] = weight[:, :3, 0] @ shift  # a flag that acts like a shift
    unflagged[first][:, 3] = 0

    parameters = annealing(flagged, pair.x, pair.y)

    np.testing.assert_allclose(parameters, annealing(unflagged, pair.x, pair.y + shift))
