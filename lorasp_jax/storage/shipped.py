"""What comes with the project, written the same way in every folder: configs/ and assets/.

A checkout has both beside the package. A wheel has them inside it, with the nano bases alone.
"""

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
ROOT = PACKAGE if (PACKAGE / "assets").is_dir() else PACKAGE.parent
"""The folder with configs/ and assets/: of a checkout its root, else the installed package."""
BASES, EXPERIMENTS = "assets", "configs"


def is_one(path: Path, folder: str) -> bool:
    """Whether a relative path is one of a shipped file or folder, such as assets/pi0_nano."""
    return path.parts[:1] == (folder,) and len(path.parts) > 1 and ".." not in path.parts


def no_base(name: str) -> str:
    """Why there is no base at a path below assets/, and where one is."""
    found = ", ".join(sorted(file.parent.name for file in ROOT.glob(f"{BASES}/*/config.json")))
    missing = f"{name} is not there: the bases in {ROOT / BASES} are {found or 'none'}"
    if ROOT != PACKAGE:
        return missing
    return (
        f"{missing}; take {Path(name).name} from a checkout of the project or make it by "
        f"{EXPERIMENTS}/pretrain.py, and name its folder, or choose a size that is there"
    )
