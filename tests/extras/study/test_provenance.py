import subprocess

import jax

from lorasp_jax.extras.study import provenance
from lorasp_jax.extras.study.provenance import _commit


def test_a_result_says_device_versions_code_and_date():
    found = provenance.provenance()
    assert set(found) == {"device", "versions", "code", "commit", "date"}
    assert found["device"] == jax.devices()[0].device_kind
    assert f"jax {jax.__version__}" in found["versions"]
    assert len(found["code"]) == 16


def test_the_commit_is_that_of_the_package_alone(tmp_path):
    def git(*arguments):
        settings = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", "-C", tmp_path, *settings, *arguments], check=True)

    assert not _commit(tmp_path)
    git("init", "-q")
    (tmp_path / "__init__.py").write_text("")
    assert not _commit(tmp_path), "a package that the repository ignores"
    git("add", ".")
    git("commit", "-qm", "first")
    assert len(_commit(tmp_path)) == 12
    (tmp_path / "__init__.py").write_text("changed = True")
    assert _commit(tmp_path).endswith("+")
