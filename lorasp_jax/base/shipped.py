"""Files shipped with the project, in configs/ and assets/.

In a checkout, both folders are beside the package. In a wheel, they are inside it, and assets/ has
only the nano bases.
"""

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
ROOT = PACKAGE if (PACKAGE / "assets").is_dir() else PACKAGE.parent
"""Folder that contains configs/ and assets/: the root of a checkout, or the installed package."""
BASES, EXPERIMENTS = "assets", "configs"


def is_under(path: Path, folder: str) -> bool:
    """Return whether a relative path is below a shipped folder, such as assets/pi0_nano."""
    return path.parts[:1] == (folder,) and len(path.parts) > 1 and ".." not in path.parts
