# SPDX-License-Identifier: Apache-2.0
"""What a `HubServer` answers to those who read."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from hub_repository import Answer, Asked, HubError, blob_id, content_id, is_large, json_answer

API = r"/api/(?P<type>models|datasets)/(?P<repo>[^/]+/[^/]+)"


def who_am_i(asked: Asked) -> Answer:
    """What `whoami` returns."""
    if asked.user is None:
        raise HubError(None, "Invalid username or password.", HTTPStatus.UNAUTHORIZED)
    return json_answer({"type": "user", "name": asked.user, "fullname": asked.user, "orgs": []})


def repository_info(asked: Asked) -> Answer:
    """What `repo_info`, `model_info` and `dataset_info` return."""
    siblings: list[dict[str, Any]] = [{"rfilename": path} for path in sorted(asked.files)]
    if "blobs" in asked.options:
        for sibling in siblings:
            content = asked.files[sibling["rfilename"]]
            sibling.update(size=len(content), blobId=blob_id(content))
    return json_answer(
        {
            "_id": asked.sha[:24],
            "id": asked.repo_id,
            "author": asked.repo_id.partition("/")[0],
            "sha": asked.sha,
            "private": asked.repository.is_private,
            "gated": False,
            "disabled": False,
            "tags": [],
            "siblings": siblings,
        }
    )


def references(asked: Asked) -> Answer:
    """What `list_repo_refs` returns."""

    def listed(kind: str, refs: Mapping[str, str]) -> list[dict[str, str]]:
        return [
            {"name": name, "ref": f"refs/{kind}/{name}", "targetCommit": sha} for name, sha in refs.items()
        ]

    repository = asked.repository
    return json_answer(
        {
            "branches": listed("heads", repository.branches),
            "tags": listed("tags", repository.tags),
            "converts": [],
            "pullRequests": [],
        }
    )


def tree(asked: Asked) -> Answer:
    """What `list_repo_tree` returns, and `snapshot_download` goes by."""
    folder = f"{asked.path}/" if asked.path else ""
    found = {path: entry for path, entry in _entries(asked.files).items() if path.startswith(folder)}
    if folder and not found:
        raise HubError("EntryNotFound", f"{asked.path} does not exist")
    if asked.options.get("recursive") != ["true"]:
        found = {path: entry for path, entry in found.items() if "/" not in path.removeprefix(folder)}
    return json_answer(list(found.values()))


def paths_info(asked: Asked) -> Answer:
    """What `get_paths_info` returns."""
    entries = _entries(asked.files)
    wanted = parse_qs(asked.body.decode()).get("paths", [])
    return json_answer([entries[path] for path in wanted if path in entries])


def file_content(asked: Asked) -> Answer:
    """A file, or what `hf_hub_download` wants to know before it asks for that."""
    if asked.path not in asked.files:
        raise HubError("EntryNotFound", "Entry not found")
    content = asked.files[asked.path]
    return Answer(content, {"ETag": f'"{content_id(asked.path, content)}"', "X-Repo-Commit": asked.sha})


# The paths are matched while still quoted: a slash inside a revision is no separator.
READS: list[tuple[str, str, Callable[[Asked], Answer]]] = [
    ("GET", r"/api/whoami-v2", who_am_i),
    ("GET", rf"{API}(/revision/(?P<revision>[^/]+))?", repository_info),
    ("GET", rf"{API}/refs", references),
    ("GET", rf"{API}/tree/(?P<revision>[^/]+)(/(?P<path>.+))?", tree),
    ("POST", rf"{API}/paths-info/(?P<revision>[^/]+)", paths_info),
    (
        "GET",
        r"(?P<type>/datasets)?/(?P<repo>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<path>.+)",
        file_content,
    ),
]


def _entries(files: Mapping[str, bytes]) -> dict[str, dict[str, Any]]:
    """Files and folders as the Hub describes them, by path."""
    folders = {str(parent) for path in files for parent in Path(path).parents} - {"."}
    entries: dict[str, dict[str, Any]] = {
        path: {"type": "directory", "path": path, "oid": blob_id(path.encode()), "size": 0}
        for path in folders
    }
    for path, content in files.items():
        entries[path] = {"type": "file", "path": path, "oid": blob_id(content), "size": len(content)}
        if is_large(path):
            sha256 = hashlib.sha256(content).hexdigest()
            entries[path]["lfs"] = {"oid": sha256, "size": len(content), "pointerSize": 130}
    return dict(sorted(entries.items()))
