# SPDX-License-Identifier: Apache-2.0
"""Publishes the dataset that a command writes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_pf2mp.commands.command import dataset_name_and_root
from lerobot_pf2mp.errors import explained


@contextmanager
def published_if_asked(
    repo_id: str | None, root: Path | None, push_to_hub: bool, private: bool | None
) -> Iterator[None]:
    """Publishes the dataset that a `with` block writes, if the command line asks for it.

    The name and the login are checked before the block. The arguments are the options of the same names.

    Raises:
        ValueError: If the dataset has no name of the form ``user/name``, or it cannot be published with these options.
        OSError: If the user is not logged in, or the Hub cannot be reached or refuses.
    """
    if not push_to_hub:
        if private is not None:
            raise ValueError("--private needs --push_to_hub=true, which publishes the dataset")
        yield
        return
    from lerobot_pf2mp.hub.publish_dataset import publish_dataset
    from lerobot_pf2mp.hub.publishing import check_destination

    repo_id, root = dataset_name_and_root(check_destination(repo_id), root, "")
    yield
    with explained(f"the dataset was written to {root}"):
        url = publish_dataset(root, repo_id, private=private)
    print(f"Published it at {url}.")
