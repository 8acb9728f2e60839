"""No test uses the network: the Hub client is patched, and the bucket is in memory."""

import logging
import re
import sys
import types

import fsspec
import huggingface_hub
import pytest
from huggingface_hub.errors import LocalEntryNotFoundError

from lorasp_jax.base import hub, shipped


def test_local_paths_are_unchanged(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "base").mkdir(parents=True)
    assert hub.local("runs/base").samefile(tmp_path / "runs" / "base")
    assert hub.local(tmp_path) == tmp_path


def test_hub(tmp_path, monkeypatch):
    request = {}

    def snapshot_download(name, **options):
        request.update(options, name=name)
        return str(tmp_path)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    assert hub.local("hf://lerobot/smolvla_base", only=["*.json"]) == tmp_path
    assert (request["name"], request["allow_patterns"]) == ("lerobot/smolvla_base", ["*.json"])
    assert "train_state/*" in request["ignore_patterns"]
    assert request["repo_type"] == "model"
    hub.local("hf://lerobot/pusht", repository="dataset")
    assert request["repo_type"] == "dataset"


def test_hub_errors_are_one_sentence(monkeypatch):
    def snapshot_download(name, **_):
        raise LocalEntryNotFoundError("Got: no connection\nand a page of explanations")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    with pytest.raises(ValueError, match=r"cannot download hf://a/b: .*no connection\)$") as caught:
        hub.local("hf://a/b")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["/a/b", "a", "a/b/c", "n" * 300, "/" + "n" * 300, "a\0b"])
def test_missing_paths(name, no_hub):
    with pytest.raises(ValueError, match=f"^{re.escape(name)} does not exist"):
        hub.local(name)


@pytest.mark.parametrize("name", ["runs/base", "lerobot/smolvla_base"])
def test_missing_folders_never_resolve_to_the_hub(name, tmp_path, monkeypatch, no_hub):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=f"{name} does not exist; .*, pass hf://{name}$"):
        hub.local(name)
    with pytest.raises(ValueError, match="a Hub repository must be hf://owner/name, got"):
        hub.local("hf://too/many/parts")


@pytest.fixture
def no_hub(monkeypatch):
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda *_, **__: 1 / 0)


def test_shipped_bases_resolve_from_any_folder(tmp_path, monkeypatch, no_hub):
    monkeypatch.chdir(tmp_path)
    assert (hub.local("assets/pi0_nano") / "config.json").is_file()
    for name in ("assets/pi0_nan", "assets/../runs/pi0"):
        with pytest.raises(
            ValueError,
            match=r"does not exist; bases in .*: pi0_nano, |does not exist; pass a path",
        ):
            hub.local(name)


def test_portable_paths_resolve_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    for where in ("mine", str(tmp_path / "mine")):
        assert hub.portable_path(where) == str(tmp_path / "mine")
    for where in ("assets/pi0_nano", str(shipped.ROOT / "assets" / "pi0_nano")):
        assert hub.portable_path(where) == "assets/pi0_nano"
    for where in ("", "gs://bucket/folder", "hf://owner/name"):
        assert hub.resolve_portable(hub.portable_path(where)) == where
    (tmp_path / "assets" / "pi0_nano").mkdir(parents=True)
    assert hub.portable_path("assets/pi0_nano") == str(tmp_path / "assets" / "pi0_nano")
    assert hub.resolve_portable("assets/pi0_nano") == str(shipped.ROOT / "assets" / "pi0_nano")


@pytest.fixture
def bucket(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    store = fsspec.filesystem("memory")
    for name in ("params/_METADATA", "params/d/0", "train_state/d/0"):
        store.pipe(f"/models/pi0/{name}", name.encode())
    yield store
    store.rm("/models", recursive=True)


def test_bucket_is_downloaded_once(bucket, tmp_path):
    folder = hub.local("memory://models/pi0/")
    assert folder == tmp_path / "lorasp_jax" / "memory" / "models" / "pi0"
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert files == {"params/_METADATA", "params/d/0"}
    assert (folder / "params" / "d" / "0").read_text() == "params/d/0"
    bucket.pipe("/models/pi0/params/d/0", b"new")
    assert (hub.local("memory://models/pi0") / "params" / "d" / "0").read_text() == "params/d/0"
    file = hub.local("memory://models/pi0/params/_METADATA")
    assert file.read_text() == "params/_METADATA"
    assert not list(tmp_path.rglob(".*"))


def test_objects_of_a_bucket_stay_in_its_folder(bucket, tmp_path):
    escaping = "/models/pi0/../../../../../evil"  # such a name is legal in a bucket
    bucket.store[escaping] = bucket.store["/models/pi0/params/d/0"]
    with pytest.raises(ValueError, match=r"'\.\./.*evil': names must stay in the folder"):
        hub.local("memory://models/pi0")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_unreadable_bucket(bucket, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"cannot download .*models/no: .*no such file or folder$"):
        hub.local("memory://models/no")

    def get_file(*_, **__):
        raise OSError("connection lost")

    monkeypatch.setattr(type(bucket), "get_file", get_file)
    with pytest.raises(ValueError, match=r"cannot download .*: connection lost$"):
        hub.local("memory://models/pi0")
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]


def test_an_unreachable_bucket_is_reported_once(monkeypatch, caplog, tmp_path):
    def url_to_fs(url):
        logging.getLogger("gcsfs").error("out of retries")
        raise OSError("no such host")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "gcsfs", types.ModuleType("gcsfs"))
    monkeypatch.setattr(fsspec.core, "url_to_fs", url_to_fs)
    with pytest.raises(ValueError, match=r"cannot download gs://bucket/folder: no such host$"):
        hub.local("gs://bucket/folder")
    assert caplog.records == []


@pytest.mark.parametrize(
    "where",
    [
        *("nothing://models/pi0", "://a", "file:///etc/passwd", "http://localhost:9/x"),
        *(
            "github://a:b@/x",
            "gs://../../x",
            "gs://a/../../../../x",
            "gs://",
            "gs://a//b",
            "s3://a/b",
        ),
        *("zip://x::/tmp/x.zip", "simplecache::file:///etc/passwd", "local:///etc/passwd"),
    ],
)
def test_other_urls_are_rejected(where, monkeypatch):
    monkeypatch.delattr("fsspec.core.url_to_fs")
    with pytest.raises(ValueError, match="a bucket URL must be gs://bucket/folder"):
        hub.local(where)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(ModuleNotFoundError, match="gcsfs"):
        hub.local("gs://openpi-assets/no-such")
