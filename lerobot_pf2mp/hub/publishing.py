# SPDX-License-Identifier: Apache-2.0
"""Publishes files on the Hugging Face Hub. All go into one commit, so that nobody can download half of them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, get_session
from huggingface_hub.constants import HF_HUB_DOWNLOAD_TIMEOUT
from huggingface_hub.errors import HFValidationError, RevisionNotFoundError
from huggingface_hub.utils import validate_repo_id

from lerobot_pf2mp.errors import explained

# How long the Hub may be silent while something is published [s]. `huggingface_hub` itself would wait for ever.
_SILENCE = float(HF_HUB_DOWNLOAD_TIMEOUT) if "HF_HUB_DOWNLOAD_TIMEOUT" in os.environ else 120.0


def check_destination(repo_id: str | None) -> str:
    """Checks the name of a repository and the login. Both can be checked before there is anything to publish.

    Args:
        repo_id: The repository.

    Returns:
        The same name.

    Raises:
        ValueError: If it is not of the form ``user/name``.
        OSError: If the user is not logged in, or the Hub cannot be reached.
    """
    rule = f"--repo_id must be the name of a repository on the Hub, user/name, got {repo_id}"
    user, slash, name = (repo_id or "").partition("/")
    if repo_id is None or not (user and slash and name) or user == "local":
        raise ValueError(rule)
    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise ValueError(f"{rule}: {error}") from error
    with _publishing(repo_id):
        HfApi().whoami()
    return repo_id


def publish(
    repo_id: str,
    repo_type: Literal["model", "dataset"],
    files: Mapping[str, Path | bytes],
    *,
    message: str,
    private: bool | None = None,
    branch: str | None = None,
    tag: str | None = None,
    owned_folders: Iterable[str] = (),
) -> str:
    """Publishes files in one commit to a repository, which is created if it does not exist.

    Args:
        repo_id: The repository, ``user/name``.
        repo_type: Type of the repository.
        files: Files or their contents, by path in the repository.
        message: First line of the commit's message.
        private: Whether a new repository is private; None for the Hub's default.
        branch: Branch, created if it does not exist; None for main.
        tag: A tag for the commit. If another commit has this tag, the tag is moved.
        owned_folders: Folders of the repository. Files in them that are not in `files` are removed.

    Returns:
        The repository's address.

    Raises:
        OSError: If the Hub cannot be reached or refuses.
        ValueError: If the repository is to be private and is public already, or the connection breaks. Then no file is
            published or all are, and the same call can be repeated.
    """
    api = HfApi()
    with _publishing(repo_id):
        url = api.create_repo(repo_id, repo_type=repo_type, private=private, exist_ok=True)
        if private and not api.repo_info(repo_id, repo_type=repo_type).private:
            raise ValueError("it is public already, which --private=true does not change")
        if branch is not None:
            api.create_branch(repo_id, repo_type=repo_type, branch=branch, exist_ok=True)
        present = api.list_repo_files(repo_id, repo_type=repo_type, revision=branch)
        folders = tuple(f"{folder}/" for folder in owned_folders)
        commit = api.create_commit(
            repo_id,
            repo_type=repo_type,
            revision=branch,
            commit_message=message,
            operations=[
                *(
                    CommitOperationAdd(path, content if isinstance(content, bytes) else str(content))
                    for path, content in files.items()
                ),
                *(
                    CommitOperationDelete(path)
                    for path in present
                    if path.startswith(folders) and path not in files
                ),
            ],
        )
        if tag is not None:
            with suppress(RevisionNotFoundError):
                api.delete_tag(repo_id, repo_type=repo_type, tag=tag)
            api.create_tag(repo_id, repo_type=repo_type, tag=tag, revision=commit.oid)
    return str(url)


@contextmanager
def _publishing(repo_id: str) -> Iterator[None]:
    """Says of any error of a `with` block what cannot be published, and does not wait for ever for the Hub."""
    session = get_session()
    timeout = session.timeout
    session.timeout = _SILENCE
    try:
        with explained(f"{repo_id} cannot be published"):
            yield
    finally:
        session.timeout = timeout
