"""Files of earlier versions still load and give the same outputs.

Commit 9fd9abf, whose LoRA-SP had 14 fields, wrote `tests/golden/adapter_sp_earlier`: an adapter of
nine layers with their outputs, and the config.json of two runs.
"""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax import peft
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config
from lorasp_jax.peft import EnergySchedule, LoRASP, LoRASPRelease
from lorasp_jax.peft._settings import upgrade
from lorasp_jax.training import run_folder
from tests import GOLDEN

FOLDER = GOLDEN / "adapter_sp_earlier"
SMALL = {"rank": 3, "hidden_width": 2}
METHODS = {
    "plain": LoRASP(**SMALL),
    "relu": LoRASP(**SMALL, router="gelu_relu", granularity="sample"),
    "softmax": LoRASP(**SMALL, router="gelu_softmax", alpha=4.0),
    "table": LoRASP.paper(rank=4),
    "moving": LoRASP(**SMALL, schedule=EnergySchedule(1.0, "cosine", 0.25)),
    "pruned": LoRASP(**SMALL, energy_target=0.99, alpha=6.0),
    "normalized": LoRASP(rank=2, hidden_width=2, normalized_bank=True),
    "release": LoRASPRelease(rank=3),
    "projection": LoRASPRelease(rank=4, hidden_width=4),
}


class Net(nnx.Module):
    def __init__(self):
        for i, name in enumerate(METHODS):
            layer = nnx.Linear(2, 2, use_bias=False, rngs=nnx.Rngs(0))
            layer.kernel.set_value(jnp.sin(jnp.arange(4.0) + i).reshape(2, 2))
            setattr(self, name, layer)

    def __call__(self, x):
        return jnp.stack([getattr(self, name)(x) for name in METHODS])


@pytest.mark.parametrize("again", [False, True], ids=["earlier", "saved again"])
def test_adapter_gives_the_same_outputs(tmp_path, again):
    model = lorasp_jax.load_adapters(FOLDER, Net())
    if again:
        lorasp_jax.save_adapters(tmp_path, model)
        assert "rule" not in (tmp_path / "adapter.json").read_text()
        model = lorasp_jax.load_adapters(tmp_path, Net())
        model = lorasp_jax.load_adapters(FOLDER, model)  # the same adapters
    assert adaptation.methods(model) == METHODS
    expected = np.load(FOLDER / "outputs.npz")
    np.testing.assert_allclose(model(expected["x"]), expected["y"], rtol=1e-5, atol=1e-5)
    aux = lorasp_jax.collect_aux(model)
    for i, name in enumerate(METHODS):
        np.testing.assert_array_equal(aux[name].active_rank, expected["active_rank"][i])
        np.testing.assert_allclose(aux[name].kept_energy, expected["kept"][i], rtol=1e-5)


@pytest.mark.parametrize(
    ("file", "method"),
    [
        (
            "run_config.json",
            LoRASP(rank=8, router="softmax", hidden_width=4, schedule=EnergySchedule(0.5)),
        ),
        ("run_config_release.json", LoRASPRelease(rank=8)),
    ],
)
def test_a_run_resumes(tmp_path, file, method):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "config.json").write_bytes((FOLDER / file).read_bytes())
    config = Config(name="a", scale="cpu", peft=method)
    with run_folder.open_run(config, tmp_path, resume=True) as folder:
        assert folder == tmp_path / "a"
    other = dataclasses.replace(config, peft=dataclasses.replace(method, rank=4))
    with (
        pytest.raises(ValueError, match=r"different settings \(peft.rank\)"),
        run_folder.open_run(other, tmp_path, resume=True),
    ):
        pass


@pytest.mark.parametrize("method", [*METHODS.values(), peft.LoRA(rank=2), peft.AdaLoRA(rank=4)])
def test_settings_round_trip(method):
    settings = json.loads(json.dumps(peft.to_settings(method)))
    assert peft.from_settings(settings) == method
    assert upgrade(settings) == settings
