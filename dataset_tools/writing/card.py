# SPDX-License-Identifier: Apache-2.0
"""The beginning of every dataset's card, which the Hub and `datasets` read."""

_HEADER = """\
---
license: apache-2.0
task_categories: [robotics]
tags: [LeRobot, pf2mp, {topic}]
configs:
- config_name: default
  data_files: data/*/*.parquet
---
"""


def card_header(topic: str) -> str:
    """The YAML block at the beginning of a card.

    It names the files with the frames. Without that, ``datasets.load_dataset`` would take the metadata for data.

    Args:
        topic: A tag, for example "maze".
    """
    return _HEADER.format(topic=topic)
