# SPDX-License-Identifier: Apache-2.0
"""What a `HubServer` answers to those who write."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable
from http import HTTPStatus

import yaml
from hub_reads import API
from hub_repository import Answer, Asked, HubError, Repository, content_id, is_large, json_answer


def create_repository(asked: Asked) -> Answer:
    """What `create_repo` does. As on the real Hub, a new repository begins with a commit of its own."""
    owner = asked.json.get("organization") or asked.writer
    if owner != asked.writer:
        raise HubError(
            None,
            f'You don\'t have the rights to create a repository under the namespace "{owner}"',
            HTTPStatus.FORBIDDEN,
        )
    repo_type, repo_id = asked.json.get("type") or "model", f"{owner}/{asked.json['name']}"
    url = f"{asked.hub.url}/{'datasets/' if repo_type == 'dataset' else ''}{repo_id}"
    if (repo_type, repo_id) in asked.hub.repositories:
        raise HubError(None, "You already created this repo", HTTPStatus.CONFLICT, url=url)
    repository = Repository(is_private=asked.json.get("visibility") == "private")
    repository.commit({".gitattributes": b"*.safetensors filter=lfs\n"})
    asked.hub.repositories[repo_type, repo_id] = repository
    return json_answer({"url": url, "name": repo_id})


def validate_yaml(asked: Asked) -> Answer:
    """What `create_commit` wants to know of a card."""
    _, fence, rest = asked.json["content"].partition("---\n")
    try:
        metadata = yaml.safe_load(rest.partition("\n---")[0]) if fence else None
    except yaml.YAMLError as error:
        raise HubError(
            None, "Invalid metadata", HTTPStatus.BAD_REQUEST, errors=[{"message": str(error)}], warnings=[]
        ) from error
    warnings = [] if metadata else [{"message": "empty or missing yaml metadata in repo card"}]
    return json_answer({"errors": [], "warnings": warnings})


def prepare_upload(asked: Asked) -> Answer:
    """Which files go through the large file storage, and what is there already."""
    present = asked.own_repository.files(asked.revision)
    return json_answer(
        {
            "files": [
                {
                    "path": (path := file["path"]),
                    "uploadMode": "lfs" if is_large(path) else "regular",
                    "shouldIgnore": False,
                    "oid": content_id(path, present[path]) if path in present else None,
                }
                for file in asked.json["files"]
            ]
        }
    )


def prepare_large_files(asked: Asked) -> Answer:
    """The batch request of git's large file storage: where to put what is not there yet."""
    _ = asked.own_repository
    objects = []
    for wanted in asked.json["objects"]:
        described = {"oid": wanted["oid"], "size": wanted["size"]}
        if wanted["oid"] not in asked.hub.large_files:
            described["actions"] = {
                "upload": {"href": f"{asked.hub.url}/storage/{wanted['oid']}"},
                "verify": {"href": f"{asked.hub.url}/storage-check"},
            }
        objects.append(described)
    return json_answer({"transfer": "basic", "objects": objects})


def store_large_file(asked: Asked) -> Answer:
    """Takes the content of a large file, which is not part of a repository yet."""
    if hashlib.sha256(asked.body).hexdigest() != asked.path:
        raise HubError(None, "The content does not match its hash", HTTPStatus.BAD_REQUEST)
    asked.hub.large_files[asked.path] = asked.body
    return Answer(b"")


def verify_large_file(asked: Asked) -> Answer:
    """Whether a large file has arrived whole."""
    content = asked.hub.large_files.get(asked.json["oid"])
    if content is None or len(content) != asked.json["size"]:
        raise HubError(None, "The file has not arrived", HTTPStatus.BAD_REQUEST)
    return Answer(b"")


def commit(asked: Asked) -> Answer:
    """What `create_commit` sends: one operation on each line, all of which are done or none."""
    repository = asked.own_repository
    if asked.revision not in repository.branches:
        raise HubError("RevisionNotFound", f"Invalid rev id: {asked.revision}")
    files, message = dict(repository.files(asked.revision)), ""
    for line in asked.body.splitlines():
        operation = json.loads(line)
        value = operation["value"]
        match operation["key"]:
            case "header":
                message = value["summary"]
            case "file":
                files[value["path"]] = base64.b64decode(value["content"])
            case "lfsFile":
                if value["oid"] not in asked.hub.large_files:
                    raise HubError(None, f"{value['path']} was never uploaded", HTTPStatus.BAD_REQUEST)
                files[value["path"]] = asked.hub.large_files[value["oid"]]
            case "deletedFile":
                if files.pop(value["path"], None) is None:
                    raise HubError("EntryNotFound", "A file with this name doesn't exist")
            case other:
                raise HubError(None, f"this Hub knows no {other}", HTTPStatus.NOT_IMPLEMENTED)
    sha = repository.commit(files, asked.revision)
    repository.messages[sha] = message
    url = f"{asked.hub.url}/{asked.repo_id}/commit/{sha}"
    return json_answer({"success": True, "commitUrl": url, "commitOid": sha, "hookOutput": ""})


def create_tag(asked: Asked) -> Answer:
    """What `create_tag` does."""
    repository = asked.own_repository
    if asked.json["tag"] in repository.tags:
        raise HubError(None, "Tag reference exists already", HTTPStatus.CONFLICT)
    repository.tags[asked.json["tag"]] = asked.sha
    return Answer(b"")


def delete_tag(asked: Asked) -> Answer:
    """What `delete_tag` does."""
    if asked.own_repository.tags.pop(asked.revision, None) is None:
        raise HubError("RevisionNotFound", f"Tag {asked.revision} does not exist")
    return Answer(b"")


def create_branch(asked: Asked) -> Answer:
    """What `create_branch` does."""
    repository = asked.own_repository
    if asked.revision in repository.branches:
        raise HubError(None, "Reference already exists", HTTPStatus.CONFLICT)
    repository.branches[asked.revision] = repository.resolve(asked.json.get("startingPoint", "main"))
    return Answer(b"")


UPLOADS: list[tuple[str, str, Callable[[Asked], Answer]]] = [
    ("POST", r"/api/repos/create", create_repository),
    ("POST", r"/api/validate-yaml", validate_yaml),
    ("POST", rf"{API}/preupload/(?P<revision>[^/]+)", prepare_upload),
    (
        "POST",
        r"(?P<type>/datasets)?/(?P<repo>[^/]+/[^/]+)\.git/info/lfs/objects/batch",
        prepare_large_files,
    ),
    ("PUT", r"/storage/(?P<path>[0-9a-f]{64})", store_large_file),
    ("POST", r"/storage-check", verify_large_file),
    ("POST", rf"{API}/commit/(?P<revision>[^/]+)", commit),
    ("POST", rf"{API}/tag/(?P<revision>[^/]+)", create_tag),
    ("DELETE", rf"{API}/tag/(?P<revision>[^/]+)", delete_tag),
    ("POST", rf"{API}/branch/(?P<revision>[^/]+)", create_branch),
]
