"""Test the public API: removing a name, or exposing another one unintentionally, fails here."""

import importlib
import importlib.metadata
import inspect
import pkgutil
import subprocess
import sys

import pytest

import lorasp_jax
from lorasp_jax import peft

PUBLIC = {
    "lorasp_jax": """
        AdaLoRA DoRA FullFineTuning LinenAdapter LoRA LoRAMoE LoRASP LoRASPRelease adapt
        auxiliary_loss auxiliary_losses choose collect_aux combine config count data dense distill
        evaluation extract fuse hugging_face input_moments load_adapters load_peft merge models
        named peft penalties policies prune quantize save_adapters save_peft split summary swap
        training unmerge with_dropout
    """,
    "lorasp_jax.peft": """
        AdaLoRA Aux DoRA FullFineTuning LoRA LoRAMoE LoRASP LoRASPRelease Method
        create find from_settings names to_settings
    """,
    "lorasp_jax.models": """
        Observation lerobot_names load load_config openpi_configs pi0 published save set_arrays
        smolvla weights_hash
    """,
    "lorasp_jax.policies": "Policy Processor PromptTable statistics_files tokenizer",
    "lorasp_jax.data": "Stream cache open_source",
    "lorasp_jax.training": "load_policy",
    "lorasp_jax.evaluation": "Result evaluate make_rollout measure_held_out",
    "lorasp_jax.extras.study": "Cell Derived Study",
    "envs": """
        Env Episodes Randomization State Trajectory collect interop
        make mjcf rlds robots
    """,
}
"""Contents of `__all__` by module."""
SHOWN = {
    "lorasp_jax.dense": "AdapterParam Dense LinenDense dense",
    "lorasp_jax.models.pi0": "Pi0Config",
    "lorasp_jax.models.published": "load_published",
    "lorasp_jax.models.smolvla": "SmolVLAConfig",
    "lorasp_jax.config": "Config DataConfig EvaluationConfig ModelConfig OptimConfig",
    "lorasp_jax.base.compilation_cache": "enable",
    "envs.interop.brax": "BraxEnv",
    "envs.interop.gymnasium": "VectorEnv",
    "envs.mjcf": "load",
    "envs.rlds": "read",
    "envs.robots.piper": "forward_kinematics",
}
"""Other names that the README, the documentation and the configs use."""


@pytest.mark.parametrize("module", PUBLIC)
def test_all_lists_the_public_names(module):
    assert sorted(importlib.import_module(module).__all__) == sorted(PUBLIC[module].split())


@pytest.mark.parametrize(("module", "names"), [*PUBLIC.items(), *SHOWN.items()])
def test_every_public_name_exists(module, names):
    for name in names.split():
        assert pkgutil.resolve_name(f"{module}.{name}") is not None


def test_every_method_is_public():
    methods = {peft.find(name).__name__ for name in peft.names()}
    assert methods <= set(lorasp_jax.__all__)


def test_saving_and_loading_are_documented():
    for name in ("split", "save_adapters", "load_adapters", "save_peft", "load_peft"):
        assert inspect.getdoc(getattr(lorasp_jax, name))


def test_version_matches_the_installed_package():
    assert lorasp_jax.__version__ == importlib.metadata.version("lorasp_jax")


def test_folder_of_the_same_name_does_not_shadow_the_package(tmp_path):
    """This happens if Python starts next to a checkout."""
    (tmp_path / "lorasp_jax" / "data").mkdir(parents=True)
    code = "import lorasp_jax.data.keys; lorasp_jax.adapt"
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
