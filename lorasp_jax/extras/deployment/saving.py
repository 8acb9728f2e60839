"""Save a deployment variant as a folder that the policy server serves."""

from pathlib import Path

from lorasp_jax.base.files import check_local
from lorasp_jax.extras.deployment import measurement, variants
from lorasp_jax.training import export


def save(run: Path, name: str, out: Path) -> None:
    """Make one variant of a run and write it to a new folder.

    The folder has the adapters and refers to the run's base, or has the merged weights. A base in
    int8 or nf4 is quantized whenever the folder is loaded.

    Raises:
        ValueError: the variant is unknown, the folder exists, or see `measurement.load`.
    """
    variant = variants.find(name)
    check_local(out)
    if out.exists():
        raise ValueError(f"{out} exists already: choose another --out")
    policy, _, settings = measurement.load(run)
    calibration = measurement.calibration_episodes(settings)
    deployed = variants.in_form(policy, variant.form, calibration)
    export.write_variant(out, deployed, run, quantized=variants.BASES[variant.base])
