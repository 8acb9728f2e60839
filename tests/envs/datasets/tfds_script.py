"""Run by the tests in an environment with tensorflow-datasets, without this project.

    python tfds_script.py OURS THEIRS FILE

Reads a dataset of this project, stores its arrays in a file, and writes the dataset again.
"""

import json
import pathlib
import sys

import numpy as np
import tensorflow_datasets as tfds

OURS, THEIRS, FILE = map(pathlib.Path, sys.argv[1:])
PICTURES = ("image", "wrist_image")
source = tfds.builder_from_directory(OURS).as_data_source("train")
encoded = tfds.builder_from_directory(OURS).as_data_source(
    "train",
    decoders={"steps": {"observation": {name: tfds.decode.SkipDecoding() for name in PICTURES}}},
)


class Press(tfds.core.GeneratorBasedBuilder):
    """The same episodes, written by tfds, which takes encoded pictures without TensorFlow."""

    VERSION = tfds.core.Version("2.0.0")

    def _info(self):
        return tfds.core.DatasetInfo(
            builder=self,
            features=tfds.features.FeaturesDict.from_config(OURS),
            metadata=tfds.core.MetadataDict(json.loads((OURS / "metadata.json").read_text())),
            disable_shuffling=True,
        )

    def _split_generators(self, dl_manager):
        return {"train": self._generate_examples()}

    def _generate_examples(self):
        for number, episode in enumerate(encoded):
            steps = list(episode["steps"])
            yield number, {"steps": steps, "episode_metadata": episode["episode_metadata"]}


arrays = {}
for number, episode in enumerate(source):
    steps = list(episode["steps"])
    for name in (*PICTURES, "state"):
        values = np.stack([step["observation"][name] for step in steps])
        arrays[f"{number}/{name}"] = values
    arrays[f"{number}/action"] = np.stack([step["action"] for step in steps])
    arrays[f"{number}/text"] = np.array([step["language_instruction"] for step in steps])
np.savez(FILE, **arrays)
builder = Press(data_dir=THEIRS, file_format="array_record")
builder.download_and_prepare(download_config=tfds.download.DownloadConfig(try_download_gcs=False))
assert not {"tensorflow", "jax", "envs", "lorasp_jax"} & sys.modules.keys()
