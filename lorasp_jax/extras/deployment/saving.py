"""Save a deployment variant as a folder that the policy server serves."""

from pathlib import Path

from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.base.files import check_local
from lorasp_jax.extras.deployment import variants
from lorasp_jax.extras.study.held_out import held_out_demonstrations
from lorasp_jax.training import export
from lorasp_jax.training.finished_run import recorded_config


def check_run(run: Path) -> None:
    """Raise ValueError unless a run is finished, can be simulated, and was trained with LoRA-SP."""
    method = recorded_config(run).peft
    if not variants.is_bank(method):
        name = type(method).__name__
        raise ValueError(f"{run} was trained with {name}: only LoRA-SP runs have variants")


def save(run: Path, name: str, out: Path) -> None:
    """Make one variant of a run and write it to a new folder.

    The folder has the adapters and refers to the run's base, or has the merged weights. A base in
    int8 or nf4 is quantized whenever the folder is loaded.

    Raises:
        ValueError: the variant is unknown, or the folder exists.
    """
    form, base = variants.check(name).split("-")
    check_local(out)
    if out.exists():
        raise ValueError(f"{out} exists already: choose another --out")
    cache.enable()
    policy = export.load_policy(run)
    # Those on which `measurement` calibrates.
    episodes = held_out_demonstrations(run / "deployment", recorded_config(run))
    deployed = variants.in_form(policy, form, episodes)
    export.write_variant(out, deployed, run, quantized=variants.BASES[base])
