"""Each patch gets the rank of its own token, and the policy runs at every step."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from lorasp_jax.evaluation import make_rollout, metrics, rank_episode
from lorasp_jax.evaluation.rank_episode import RankEpisode, patch_ranks
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.models.transformer.siglip import patches
from lorasp_jax.peft import Aux
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Offline
from lorasp_jax.training.run_folder import to_json
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, make_run
from tests.training.test_export import with_random_adapters

NANO = {"pi0": Pi0Config.nano(), "smolvla": SmolVLAConfig.nano()}
PIXELS = 128  # twice the backbone's, so that images are resized


def nano_policy(folder, model_config, targets=("vision/patch_embed",)):
    """A policy with random adapters; those of the patch embedding see one patch each."""
    config = dataclasses.replace(CONFIG, targets=targets)
    policy = make_run(folder, config, random_backbone(model_config)).policy
    return with_random_adapters(policy)


@jax.jit
def measure(policy, images):
    """Patch ranks of images `[PIXELS, PIXELS, 3]`, and those averaged by `layer_ranks`."""
    raw = {"image": {name: i[None] for name, i in images.items()}, "state": jnp.zeros((1, 7))}
    inputs = policy.processor.encode(raw, jnp.zeros(1, jnp.int32))
    aux = policy.model.encode_images(inputs)[2]
    return patch_ranks(aux, policy), metrics.layer_ranks(aux, jnp.ones(1, bool))


def random_images(seed=0, cameras=("side", "wrist")):
    rng = np.random.default_rng(seed)
    return {name: rng.integers(0, 255, (PIXELS, PIXELS, 3), np.uint8) for name in cameras}


@pytest.fixture(scope="module", params=NANO)
def policy(request, tmp_path_factory):
    return nano_policy(tmp_path_factory.mktemp("nano") / "run", NANO[request.param])


@pytest.mark.parametrize(
    ("camera", "row", "column"), [("side", 0, 3), ("side", 2, 1), ("wrist", 0, 0), ("wrist", 3, 0)]
)
def test_a_painted_patch_changes_only_its_own_rank(policy, camera, row, column):
    """Painted inside its patch, because resizing blurs the border."""
    config = policy.model.config
    size = PIXELS * config.vision.patch // config.image_size
    images = random_images()
    before, _ = measure(policy, images)
    images[camera] = images[camera].copy()
    inside = np.s_[
        size * row + 2 : size * (row + 1) - 2, size * column + 2 : size * (column + 1) - 2
    ]
    changed = {name: np.zeros(ranks.shape, bool) for name, ranks in before.items()}
    for value in (0, 90, 255):  # one of them may have the old rank
        images[camera][inside] = [value, 255 - value, 30]
        after, _ = measure(policy, images)
        for name in changed:
            changed[name] |= np.asarray(after[name] != before[name])
    positions = {name: np.argwhere(patches).tolist() for name, patches in changed.items()}
    assert positions == {"side": [], "wrist": [], camera: [[row, column]]}


@pytest.mark.parametrize("name", NANO)
def test_tokens_after_the_pixel_shuffle_cover_their_patches(name):
    """SigLIP's head sees, for each token, the patches that `siglip.patches` collects."""
    config = NANO[name]
    side, shuffle = config.image_size // config.vision.patch, config.vision.shuffle
    number = jnp.arange(2 * side**2).reshape(2, side, side, 1)
    covered = np.asarray(patches(number, shuffle))  # [cameras, tokens, patches of the token]
    ranks = np.random.default_rng(0).permutation(2 * config.image_tokens).astype(np.float32)
    ranks = ranks.reshape(2, -1)
    processor = SimpleNamespace(cameras=())
    policy = SimpleNamespace(model=SimpleNamespace(config=config), processor=processor)
    maps = patch_ranks({"vision": {"head": Aux(jnp.asarray(ranks))}}, policy)
    for camera, name in enumerate(config.cameras):
        for token, numbers in enumerate(covered[camera] - camera * side**2):
            assert (np.asarray(maps[name]).ravel()[numbers] == ranks[camera, token]).all()


def test_ranks_follow_the_robot_camera_that_fills_a_slot(policy):
    """Robot cameras in other slots, and a slot without a camera."""
    images = random_images(cameras=("a", "b"))
    config = policy.model.config
    swapped = dataclasses.replace(policy.processor, cameras=(("side", "b"), ("wrist", "a")))
    a, _ = measure(Policy(policy.model, swapped), images)
    straight, _ = measure(policy, {"side": images["b"], "wrist": images["a"]})
    assert set(a) == {"a", "b"}
    np.testing.assert_array_equal(a["b"], straight["side"])
    np.testing.assert_array_equal(a["a"], straight["wrist"])
    missing = dataclasses.replace(policy.processor, cameras=(("side", None), ("wrist", "a")))
    alone, _ = measure(Policy(policy.model, missing), images)
    assert set(alone) == {"a"}
    np.testing.assert_array_equal(alone["a"], a["a"])
    assert alone["a"].shape == (config.image_size // config.vision.patch,) * 2


@pytest.mark.slow
@pytest.mark.parametrize("name", NANO)
def test_the_mean_over_patches_is_the_tower_mean(name, tmp_path):
    policy = nano_policy(tmp_path / "run", NANO[name], targets=("vision",))
    maps, layers = measure(policy, random_images())
    assert {"patch_embed", "q_proj", "fc2", "head"} <= set(layers["vision"])
    tower = np.concatenate([*layers["vision"].values()]).mean()
    assert np.mean([*maps.values()]) == pytest.approx(tower, rel=1e-5)


def test_the_first_success_is_chosen(monkeypatch):
    env, config = SimpleNamespace(task=SimpleNamespace(name="press")), {"seed": 3}
    for outcomes, chosen in (([0, 1, 1], 1), ([1, 1], 0), ([0] * 8, 0)):
        episodes = [RankEpisode("press", bool(won), (), {}, {}) for won in outcomes]
        left = iter(episodes)
        monkeypatch.setattr(rank_episode, "play", lambda *_, left=left: next(left))
        assert rank_episode.record(None, env, config) is episodes[chosen]


@pytest.mark.slow
def test_the_robot_executes_some_actions_of_a_chunk(tmp_path):
    """With the observations of an episode, the policy gives the ranks and commands of its film."""
    env = envs.make("press", robot="piper", num_envs=1, image_size=32)
    policy = make_run(tmp_path / "run").policy
    prompts = PromptTable.of(Offline(), env.instructions, policy.model.config, num_joints=6)
    policy = Policy(policy.model, dataclasses.replace(policy.processor, prompts=prompts))
    policy, key = policy.with_sampler(), jax.random.key(5)
    settings = {"execute_steps": 3, "denoise_steps": 2}
    config = {**to_json(CONFIG), "evaluation": settings}
    found = rank_episode.play(policy, env, config, key)
    rollout = make_rollout(env, execute_steps=3, denoise_steps=2)(policy, key)
    steps = int(rollout.steps[0])
    assert len(found.poses.geom_xpos) == steps
    assert found.success == rollout.success[0]
    # A rollout records poses after each step. Rounding errors grow with time.
    after = rollout.poses.geom_xpos[:25, 0]
    np.testing.assert_allclose(found.poses.geom_xpos[1:26], after, atol=1e-4)
    assert set(found.patches) == {"side", "wrist"}
    assert found.patches["side"].shape == (steps, 2, 2)
    assert set(found.towers) == {"vision", "language", "action"}
    means = np.mean([*found.patches.values()], axis=(0, 2, 3))
    np.testing.assert_allclose(means, found.towers["vision"], rtol=1e-5)
