# SPDX-License-Identifier: Apache-2.0
"""The Hub: publishing policies and datasets and loading them again, with the real client over real HTTP.

Whatever talks to the Hub runs in a process of its own, because `huggingface_hub` reads its environment when imported.
"""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hub_server import HubServer
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import ACTION
from safetensors.torch import load_file, save_file

from lerobot_pf2mp import PF2MPMazeEnv, load_policy
from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.hub.card_facts import CardFacts, PolicyFacts
from lerobot_pf2mp.hub.model_card import env_options, make_model_card

BIN = Path(sys.executable).parent
SECONDS = 600  # for a command, on a machine that is busy with other things
STATE, ENV = "observation.state", "observation.environment_state"
FIELD_FILE = "policy_preprocessor_step_4_potential_field.safetensors"
CHECKPOINT_FILES = {
    "config.json",
    "model.safetensors",
    "policy_preprocessor.json",
    "policy_preprocessor_step_3_normalizer_processor.safetensors",
    FIELD_FILE,
    "policy_postprocessor.json",
    "policy_postprocessor_step_0_unnormalizer_processor.safetensors",
}
ZERO_TO_FOUR = {"min": torch.zeros(2), "max": torch.full((2,), 4.0)}
STATS = {
    key: {**ZERO_TO_FOUR, "mean": torch.full((2,), 2.0), "std": torch.ones(2)} for key in (STATE, ENV, ACTION)
}
SMALL: dict[str, Any] = {
    "device": "cpu",
    "n_obs_steps": 1,
    "down_dims": (8, 16),
    "horizon": 8,
    "n_action_steps": 4,
    "diffusion_step_embed_dim": 16,
    "num_inference_steps": 3,
    "input_features": {
        STATE: PolicyFeature(FeatureType.STATE, (2,)),
        ENV: PolicyFeature(FeatureType.ENV, (2,)),
    },
    "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
}
TOKENS = {"writes": "user", "reads": "user", "others": "somebody"}

# Runs cases one after the other; each says what to do, with which token, and leaves one line: {name: what came out}.
CASES = """
import json, os, sys, traceback
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot_pf2mp import load_policy
from lerobot_pf2mp.commands import cli
from lerobot.policies.factory import get_policy_class

def act(policy, preprocess, postprocess):
    rng = torch.Generator().manual_seed(7)
    batch = {key: torch.rand(3, 2, generator=rng) for key in ("observation.state", "observation.environment_state")}
    torch.manual_seed(8)
    return postprocess(policy.select_action(preprocess(batch))).tolist()

def load(path, revision=None):
    return act(*load_policy(path, revision=revision, device="cpu"))

def load_with_lerobot(path):
    config = PreTrainedConfig.from_pretrained(path)
    policy = get_policy_class(config.type).from_pretrained(path)
    return act(policy, *make_pre_post_processors(config, pretrained_path=path))

def command(name, *arguments):
    sys.argv = [name, *arguments]
    try:
        getattr(cli, name)()
    except SystemExit as stop:
        return stop.code
    return 0

for name, (what, token, *arguments) in json.loads(sys.argv[1]).items():
    os.environ["HF_TOKEN"] = token
    print(f"=== {name}", file=sys.stderr, flush=True)
    try:
        out = globals()[what](*arguments)
    except Exception as error:
        out = f"{type(error).__name__}: {error}"
    print("\\n=== " + json.dumps([name, out]), flush=True)
"""


def run(hub: HubServer, home: Path, *command: str | Path, token: str | None = None) -> str:
    """Runs a command that must succeed; returns what it says."""
    finished = subprocess.run(
        [str(part) for part in command],
        cwd=home,
        env=hub.environment(home / "cache", token),
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    said = finished.stdout + finished.stderr
    assert finished.returncode == 0, said[-8000:]
    return said


def run_cases(hub: HubServer, home: Path, cases: dict[str, list[Any]]) -> dict[str, tuple[Any, str]]:
    """What came out of each case, and what it wrote to the standard error stream."""
    finished = subprocess.run(
        [sys.executable, "-c", CASES, json.dumps(cases)],
        cwd=home,
        env=hub.environment(home / "cache"),
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    outs = dict(json.loads(line[4:]) for line in finished.stdout.splitlines() if line.startswith("=== "))
    said = dict(part.partition("\n")[::2] for part in finished.stderr.split("=== ")[1:])
    assert list(outs) == list(cases) == list(said), finished.stderr[-6000:]
    return {name: (outs[name], said[name]) for name in cases}


def make_checkpoint(path: Path, policy_type: str, seed: int = 0, **options: Any) -> Path:
    """A policy of random weights, guided by the field of a first batch if it is a guided one."""
    torch.manual_seed(seed)
    config = PreTrainedConfig.get_choice_class(policy_type)(**{**SMALL, **options})
    policy = get_policy_class(policy_type)(config, dataset_stats=STATS)
    preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=STATS)
    if policy_type != "fmp":
        policy.train()
        policy(preprocessor(training_batch()))
    for part in (policy, preprocessor, postprocessor):
        part.save_pretrained(path)
    return path


def training_batch() -> dict[str, Any]:
    return {
        STATE: 4 * torch.rand(6, 1, 2),
        ENV: 4 * torch.rand(6, 1, 2),
        ACTION: 4 * torch.rand(6, 8, 2),
        "action_is_pad": torch.zeros(6, 8, dtype=torch.bool),
        "index": 8 * torch.arange(6),
    }


def actions_of(checkpoint: Path) -> list[list[float]]:
    """What `act` returns of the same policy."""
    policy, preprocess, postprocess = load_policy(checkpoint, device="cpu")
    rng = torch.Generator().manual_seed(7)
    batch = {key: torch.rand(3, 2, generator=rng) for key in (STATE, ENV)}
    torch.manual_seed(8)
    return postprocess(policy.select_action(preprocess(batch))).tolist()


def without_field(path: Path) -> None:
    (path / FIELD_FILE).unlink()


def truncated(path: Path) -> None:
    content = (path / FIELD_FILE).read_bytes()
    (path / FIELD_FILE).write_bytes(content[: len(content) // 2])


def over_three_dimensions(path: Path) -> None:
    field = load_file(path / FIELD_FILE)
    save_file({**field, "points": torch.rand(len(field["points"]), 3)}, path / FIELD_FILE)


def without_points(path: Path) -> None:
    field = load_file(path / FIELD_FILE)
    del field["points"]
    save_file(field, path / FIELD_FILE)


def without_state(path: Path) -> None:
    change_steps(path, lambda steps: steps[-1].pop("state_file"))


def without_step(path: Path) -> None:
    change_steps(path, lambda steps: steps.pop())


def change_steps(path: Path, change: Callable[[list[dict[str, Any]]], Any]) -> None:
    file = path / "policy_preprocessor.json"
    content = json.loads(file.read_text())
    change(content["steps"])
    file.write_text(json.dumps(content))


DAMAGES: dict[str, tuple[Callable[[Path], None], str]] = {
    "without_field": (without_field, FIELD_FILE),
    "truncated": (truncated, "header|deserializ|incomplete"),
    "over_three_dimensions": (over_three_dimensions, "must cover 2 action dimensions, got a field over 3"),
    "without_points": (without_points, "must hold .*points.* it is corrupted"),
    "without_state": (without_state, "not fitted"),
    "without_step": (without_step, "guidance needs the potential field"),
}
every_damage = pytest.mark.parametrize("damage", DAMAGES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hub")


@pytest.fixture(scope="module")
def checkpoint(folder: Path) -> Callable[[str], Path]:
    """Makes each checkpoint once: one of a type, or a damaged one of pf2mp."""

    def make(name: str) -> Path:
        path = folder / name
        if not path.exists():
            if name in DAMAGES:
                shutil.copytree(make("pf2mp"), path)
                DAMAGES[name][0](path)
            else:
                make_checkpoint(path, name, license="mit", tags=["maze"])
        return path

    return make


@pytest.fixture(scope="module")
def hub() -> Iterator[HubServer]:
    with HubServer() as hub:
        hub.users.update(TOKENS)
        hub.only_reads.add("reads")
        yield hub


# The Hub of these tests.

UPLOADS = """
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi
from huggingface_hub.errors import HfHubHTTPError

def status_of(method, *args, **kwargs):
    try:
        method(*args, **kwargs)
    except HfHubHTTPError as error:
        return type(error).__name__, error.response.status_code
    return "no error"

api = HfApi(token="writes")
assert api.whoami()["name"] == "user"
for repo_type in ("model", "dataset"):
    here = {"repo_id": "user/new", "repo_type": repo_type}
    assert status_of(api.upload_file, path_or_fileobj=b"1", path_in_repo="a", **here) == ("RepositoryNotFoundError", 404)
    url = api.create_repo(**here, private=True)
    assert url.repo_id == "user/new" and url == api.create_repo(**here, exist_ok=True), url
    assert status_of(api.create_repo, **here) == ("HfHubHTTPError", 409)
    assert api.repo_info(**here).private
    before = api.repo_info(**here).sha
    add = [CommitOperationAdd(path, content) for path, content in FILES.items()]
    commit = api.create_commit(operations=add, commit_message="Files", **here)
    assert commit.oid == api.repo_info(**here).sha != before
    assert api.list_repo_files(**here) == sorted([".gitattributes", *FILES])
    for path, content in FILES.items():
        with open(api.hf_hub_download(filename=path, **here), "rb") as file:
            assert file.read() == content
    again = [CommitOperationAdd(path, content) for path, content in FILES.items()]
    assert api.create_commit(operations=again, commit_message="The same", **here).oid == commit.oid
    api.create_tag(tag="v1", **here)
    assert status_of(api.create_tag, tag="v1", **here) == ("HfHubHTTPError", 409)
    api.create_branch(branch="side", **here)
    api.create_branch(branch="side", exist_ok=True, **here)
    delete = [CommitOperationDelete("folder/a.json")]
    api.create_commit(operations=delete, commit_message="Without", revision="side", **here)
    assert "folder/a.json" not in api.list_repo_files(revision="side", **here)
    assert api.repo_info(revision="v1", **here).sha == api.repo_info(**here).sha == commit.oid
    api.delete_tag(tag="v1", **here)
    assert status_of(api.delete_tag, tag="v1", **here) == ("RevisionNotFoundError", 404)

    assert status_of(api.repo_info, token=False, **here) == ("RepositoryNotFoundError", 401)
    assert status_of(api.repo_info, token="others", **here) == ("RepositoryNotFoundError", 404)
    assert status_of(api.repo_info, token="wrong", **here) == ("HfHubHTTPError", 401)
    assert status_of(api.repo_info, token="reads", **here) == "no error"
    for token, status in (("reads", 403), ("wrong", 401)):
        refused = status_of(api.create_commit, operations=delete, commit_message="No", token=token, **here)
        assert refused == ("HfHubHTTPError", status), refused
    assert status_of(api.create_repo, "user/third", token="others") == ("HfHubHTTPError", 403)
    assert status_of(api.repo_info, "user/none", token="others") == ("RepositoryNotFoundError", 404)
assert status_of(api.whoami, token="wrong") == ("HfHubHTTPError", 401)
try:
    api.upload_file(path_or_fileobj=b"---\\n[\\n---\\n", path_in_repo="README.md", repo_id="user/new")
except ValueError as error:
    print(error)
"""


@pytest.mark.slow
def test_the_hub_of_these_tests_takes_uploads_of_the_real_client(tmp_path):
    """The other tests here could else pass for the wrong reason."""
    files = {"folder/a.json": b"{}", "b.safetensors": bytes(20_000), "c d.png": b"picture", "empty.md": b""}
    with HubServer() as hub:
        hub.users.update(TOKENS)
        hub.only_reads.add("reads")
        said = run(hub, tmp_path, sys.executable, "-c", f"FILES = {files!r}\n{UPLOADS}")
        assert "Invalid metadata in README.md" in said
        assert len(hub.large_files) == 2  # the same for both repositories
        model, dataset = (hub.repositories[kind, "user/new"] for kind in ("model", "dataset"))
    assert model.files() == dataset.files() == {**files, ".gitattributes": b"*.safetensors filter=lfs\n"}


# Loading.


@pytest.fixture(scope="module")
def loaded(hub: HubServer, checkpoint: Any, folder: Path) -> dict[str, tuple[Any, str]]:
    """What comes of loading each of many repositories."""
    old = make_checkpoint(folder / "old", "pf2mp", seed=1)
    hub.add("model", "user/repo", old, tags=["first"])
    hub.add("model", "user/repo", checkpoint("pf2mp"))
    hub.add("model", "user/dppf", checkpoint("dppf"))
    hub.add("model", "user/fmp", checkpoint("fmp"))
    hub.add("model", "user/private", checkpoint("pf2mp"), private=True)
    for damage in DAMAGES:
        hub.add("model", f"user/{damage}", checkpoint(damage))
    for file in ("model.safetensors", FIELD_FILE):
        hub.add("model", f"user/cut-{Path(file).stem}", checkpoint("pf2mp"))
        # As often as huggingface_hub tries before it gives up.
        hub.cuts[f"user/cut-{Path(file).stem}/resolve/main/{file}"] = 6
    hub.add("model", "user/flickering", checkpoint("pf2mp"))
    hub.cuts[f"user/flickering/resolve/main/{FIELD_FILE}"] = 1
    hub.broken.add("user/broken")
    cases = {
        "main": ["load", "", "user/repo"],
        "main_with_lerobot": ["load_with_lerobot", "", "user/repo"],
        "first": ["load", "", "user/repo", "first"],
        "dppf": ["load", "", "user/dppf"],
        "fmp": ["load_with_lerobot", "", "user/fmp"],
        "missing": ["load", "", "user/none"],
        "missing_revision": ["load", "", "user/repo", "none"],
        "broken": ["load", "", "user/broken"],
        "private_without_token": ["load", "", "user/private"],
        "private_with_wrong_token": ["load", "wrong", "user/private"],
        "private_with_token_of_another": ["load", "others", "user/private"],
        "private_with_token": ["load", "reads", "user/private"],
        "public_with_wrong_token": ["load", "wrong", "user/dppf", "main"],
        "flickering": ["load", "", "user/flickering"],
    }
    for damage in DAMAGES:
        cases[damage] = ["load", "", f"user/{damage}"]
        cases[f"{damage}_with_lerobot"] = ["load_with_lerobot", "", f"user/{damage}"]
    for file in ("model.safetensors", FIELD_FILE):
        for time in ("first", "second"):
            cases[f"{file}_{time}"] = ["load", "", f"user/cut-{Path(file).stem}"]
    home = folder / "loading"
    home.mkdir()
    return run_cases(hub, home, cases)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "name"),
    [
        ("main", "pf2mp"),
        ("main_with_lerobot", "pf2mp"),
        ("first", "old"),
        ("dppf", "dppf"),
        ("fmp", "fmp"),
        ("private_with_token", "pf2mp"),
        ("flickering", "pf2mp"),
        ("model.safetensors_second", "pf2mp"),
        (f"{FIELD_FILE}_second", "pf2mp"),
    ],
)
def test_a_policy_from_the_hub_acts_as_the_one_that_was_published(loaded, folder, case, name):
    assert loaded[case][0] == actions_of(folder / name)


@pytest.mark.slow
def test_these_policies_act_differently(loaded, folder):
    actions = [str(actions_of(folder / name)) for name in ("pf2mp", "old", "dppf", "fmp")]
    assert len(set(actions)) == 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("missing", "the checkpoint user/none cannot be loaded: .*Repository Not Found"),
        ("missing_revision", "user/repo at revision none cannot be loaded: .*Revision Not Found"),
        ("broken", "the checkpoint user/broken cannot be loaded: "),
        ("private_without_token", "user/private cannot be loaded: .*make sure you are authenticated"),
        ("private_with_wrong_token", "user/private cannot be loaded: .*Invalid credentials"),
        ("private_with_token_of_another", "user/private cannot be loaded: .*Repository Not Found"),
        ("model.safetensors_first", "the weights of the checkpoint user/cut-model cannot be loaded: "),
        (f"{FIELD_FILE}_first", "the processors of the checkpoint user/cut-policy.* cannot be loaded: "),
    ],
)
def test_what_cannot_be_loaded_is_said(loaded, case, message):
    assert re.match(f"(?s)(OSError|ValueError): .*{message}", str(loaded[case][0]))


@pytest.mark.slow
@every_damage
def test_a_repository_with_a_damaged_field_is_never_loaded_unguarded(loaded, damage):
    message = DAMAGES[damage][1]
    where = f"the processors of the checkpoint user/{damage} cannot be loaded: "
    assert re.match(f"(?s)(OSError|ValueError): {where}.*{message}", str(loaded[damage][0]))
    assert re.search(f"(?s)Error.*{message}", str(loaded[f"{damage}_with_lerobot"][0]))


@every_damage
def test_without_guidance_only_a_file_that_is_needed_must_be_there(checkpoint, damage):
    if damage in ("over_three_dimensions", "without_state", "without_step"):
        load_policy(checkpoint(damage), device="cpu", guidance_scale=0)
    else:
        with pytest.raises((OSError, ValueError), match="the processors of the checkpoint"):
            load_policy(checkpoint(damage), device="cpu", guidance_scale=0)


# The card.


def card_parts(text: str) -> tuple[dict[str, Any], str]:
    """A card's metadata and its text."""
    _, metadata, body = text.split("---\n", 2)
    return yaml.safe_load(metadata), body


def row_of(text: str, name: str) -> str:
    """A value from the card's table."""
    (value,) = re.findall(rf"^\| {re.escape(name)} \| (.*) \|$", text, re.MULTILINE)
    return value


@pytest.mark.parametrize("policy_type", ["fmp", "pf2mp", "dppf"])
def test_every_policy_has_a_card_of_its_own(policy_type):
    config = PreTrainedConfig.get_choice_class(policy_type)(**SMALL, repo_id="user/policy")
    policy = get_policy_class(policy_type)(config, dataset_stats=STATS)
    # As LeRobot calls it; no access to the Hub is needed.
    card = policy.generate_model_card("user/data", policy_type, "mit", ["maze"], cfg=None, dataset_meta=None)
    metadata, text = card_parts(str(card))
    assert {key: metadata[key] for key in ("library_name", "pipeline_tag", "license", "datasets")} == {
        "library_name": "lerobot",
        "pipeline_tag": "robotics",
        "license": "mit",
        "datasets": ["user/data"],
    }
    kind = "diffusion" if policy_type == "dppf" else "flow-matching"
    assert {"lerobot", "pf2mp", kind, policy_type, "maze"} <= set(metadata["tags"])
    assert len({"diffusion", "flow-matching"} & set(metadata["tags"])) == 1
    for command in (
        "pip install lerobot_policy_pf2mp",
        "lerobot-eval --policy.path=user/policy ",
        f"lerobot-train --policy.type={policy_type} --dataset.repo_id=user/data ",
        "lerobot-train --policy.path=user/policy --dataset.repo_id=user/data ",
        'load_policy("user/policy")',
        "## Limits",
        "https://huggingface.co/datasets/user/data",
    ):
        assert command in text
    assert ("guidance_scale" in text) == (policy_type != "fmp")
    assert "## Results" not in text


@pytest.mark.parametrize("policy_type", ["pf2mp", "dppf"])
def test_the_card_says_which_field_guides_the_policy(policy_type):
    options = {"guidance_scale": 0.25, "guidance_integrator": "euler", "n_field_points": 20}
    config = PreTrainedConfig.get_choice_class(policy_type)(**SMALL, **options)
    policy = get_policy_class(policy_type)(config, dataset_stats=STATS)
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=STATS)
    before = str(policy.generate_model_card("local/data", policy_type))
    assert "anchors M" not in before
    policy.train()
    policy(preprocessor(training_batch()))
    _, text = card_parts(str(policy.generate_model_card("local/data", policy_type)))
    field = preprocessor.steps[-1].demonstrations.field()
    assert row_of(text, "guidance strength lambda") == "0.25"
    assert row_of(text, "guidance integrator") == "euler"
    assert row_of(text, "anchors M") == "20 demonstrated actions"
    bandwidth = row_of(text, "bandwidth h")
    assert bandwidth == f"{field.bandwidth:.4g} [normalised action units], by the rule likelihood"


def test_a_dataset_that_is_not_on_the_hub_is_not_linked():
    policy = get_policy_class("fmp")(PreTrainedConfig.get_choice_class("fmp")(**SMALL))
    metadata, text = card_parts(str(policy.generate_model_card("local/data", "fmp")))
    assert "datasets" not in metadata
    assert row_of(text, "dataset") == "`local/data`, not published"
    assert "huggingface.co/datasets" not in text


def test_the_card_tells_lerobot_eval_the_environment():
    import draccus
    from lerobot.envs.configs import EnvConfig

    env = PF2MPMazeEnv(task="MazeUMaze-v0", episode_length=16, maze_map="11111/10001/11111")
    encoded = draccus.encode(env, EnvConfig)
    assert sorted(env_options(encoded)) == sorted(
        [
            "--env.type=pf2mp_maze",
            "--env.task=MazeUMaze-v0",
            "--env.episode_length=16",
            "--env.maze_map=11111/10001/11111",
        ]
    )
    assert env_options(None) == env_options({"type": "of somebody else"}) == []


def test_the_card_explains_columns_of_plans_where_its_table_has_them() -> None:
    policy = PolicyFacts("pf2mp", {}, {}, horizon=8, n_action_steps=4, num_inference_steps=2)
    cards = [
        str(make_model_card(CardFacts(policy, "user/repo", table=f"| policy |{columns}\n|---|")))
        for columns in ("", " plans | flagged [%] |")
    ]
    said = ["An episode is flagged if one of the executed plans" in card for card in cards]
    assert said == [False, True]


# pf2mp-push.


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command in this process, without a network, and returns the line with which it ends."""

    def refused(name: str, *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [f"pf2mp-{name}", *arguments])
        capfd.readouterr()
        with pytest.raises(SystemExit, match="1"):
            getattr(cli, name)()
        captured = capfd.readouterr()
        assert "Traceback" not in captured.err
        assert "ublished" not in captured.out
        (line,) = [line for line in captured.err.splitlines() if line.startswith("error: ")]
        return line

    return refused


@every_damage
def test_a_checkpoint_with_a_damaged_field_is_not_published(checkpoint, damage, refused):
    line = refused("push", f"--path={checkpoint(damage)}", "--repo_id=user/damaged")
    assert re.search(DAMAGES[damage][1], line)


def test_guidance_that_is_off_needs_a_field_to_be_published(tmp_path, refused):
    path = make_checkpoint(tmp_path / "off", "pf2mp", guidance_scale=0.0)
    without_state(path)
    assert "not fitted" in refused("push", f"--path={path}", "--repo_id=user/off")


def results_folder(path: Path, *without: str) -> Path:
    shutil.copytree(Path(__file__).parents[1] / "results/maze", path)
    for name in without:
        (path / name).unlink()
    return path


@pytest.mark.slow
def test_bad_arguments_of_push_end_in_one_line(checkpoint, tmp_path, refused):
    path, here = f"--path={checkpoint('fmp')}", "--repo_id=user/repo"
    assert "--path must be given" in refused("push", here)
    assert "--repo_id must be given" in refused("push", path)
    assert "pretrained_model folder, got" in refused("push", f"--path={tmp_path}/none", here)
    for name in ("repo", "local/repo", "user/", "a/b/c", "user/re po"):
        assert f"user/name, got {name}" in refused("push", path, f"--repo_id={name}")
    partial = results_folder(tmp_path / "partial", "run.json")
    assert "without ['run.json']" in refused("push", path, here, f"--results={partial}")
    (partial / "run.json").write_text("{}")
    assert "run.json must be one" in refused("push", path, here, f"--results={partial}")
    for figure in (checkpoint("fmp") / "config.json", tmp_path / "none.png"):
        assert "--figures must be files ending in" in refused("push", path, here, f"--figures=[{figure}]")
    twice = [tmp_path / name / "a.png" for name in ("one", "two")]
    for figure in twice:
        figure.parent.mkdir()
        figure.write_bytes(b"picture")
    assert "a.png twice" in refused("push", path, here, f"--figures=[{twice[0]},{twice[1]}]")
    diffusion = make_checkpoint(tmp_path / "act", "diffusion")
    assert "type must be one of ['fmp', 'pf2mp', 'dppf', 'guarded'], got 'diffusion'" in refused(
        "push", f"--path={diffusion}", here
    )


@pytest.fixture(scope="module")
def pushed(hub: HubServer, checkpoint: Any, folder: Path) -> dict[str, tuple[Any, str]]:
    """What comes of pf2mp-push with each of many arguments, and of loading what it has published."""
    results = results_folder(folder / "results")
    figure, video = folder / "a_way.png", folder / "rollout.mp4"
    figure.write_bytes(b"picture")
    video.write_bytes(b"film")
    crowded = folder / "crowded"
    shutil.copytree(checkpoint("dppf"), crowded)
    (crowded / "notes.txt").write_text("private")
    (crowded / ".hidden.json").write_text("{}")
    (crowded / "training_state").mkdir()
    (crowded / "training_state/rng.safetensors").write_bytes(b"state")
    training = {"dataset": {"repo_id": "local/data"}, "steps": 7, "batch_size": 3, "seed": None, "env": None}
    (crowded / "train_config.json").write_text(json.dumps(training))
    pf2mp = f"--path={checkpoint('pf2mp')}"
    push = ["command", "writes", "push"]
    with_all = [f"--results={results}", f"--figures=[{figure},{video}]", "--dataset=user/data"]
    cases = {
        "with_all": [*push, pf2mp, "--repo_id=user/pushed", *with_all],
        "load": ["load", "", "user/pushed"],
        "again": [*push, f"--path={crowded}", "--repo_id=user/pushed"],
        "load_again": ["load_with_lerobot", "", "user/pushed"],
        "branch": [*push, f"--path={checkpoint('fmp')}", "--repo_id=user/pushed", "--branch=unguided"],
        "load_branch": ["load", "", "user/pushed", "unguided"],
        "private": [*push, pf2mp, "--repo_id=user/secret", "--private=true"],
        "load_private": ["load", "reads", "user/secret"],
        "private_on_public": [*push, pf2mp, "--repo_id=user/pushed", "--private=true"],
        "no_token": ["command", "", "push", pf2mp, "--repo_id=user/nobody"],
        "wrong_token": ["command", "wrong", "push", pf2mp, "--repo_id=user/nobody"],
        "reading_token": ["command", "reads", "push", pf2mp, "--repo_id=user/nobody"],
        "other_user": ["command", "others", "push", pf2mp, "--repo_id=user/nobody"],
        "other_users_repository": ["command", "others", "push", pf2mp, "--repo_id=user/pushed"],
    }
    home = folder / "pushing"
    home.mkdir()
    return run_cases(hub, home, cases)


@pytest.mark.slow
def test_a_push_is_one_commit_that_holds_everything(hub, pushed, checkpoint):
    assert pushed["with_all"][0] == 0, pushed["with_all"][1]
    repository = hub.repositories["model", "user/pushed"]
    first, second, *others = repository.commits.values()
    assert set(first) == {".gitattributes"}  # the Hub's own
    assert set(second) == {
        ".gitattributes",
        "README.md",
        *CHECKPOINT_FILES,
        "results/summary.csv",
        "results/table.md",
        "results/run.json",
        "figures/a_way.png",
        "figures/rollout.mp4",
    }
    for name in CHECKPOINT_FILES:
        assert second[name] == (checkpoint("pf2mp") / name).read_bytes()
    assert len(others) == 2  # "again" and "branch"


@pytest.mark.slow
def test_a_pushed_policy_acts_as_before(pushed, folder):
    for case, name in (
        ("load", "pf2mp"),
        ("load_again", "dppf"),
        ("load_branch", "fmp"),
        ("load_private", "pf2mp"),
    ):
        assert pushed[case][0] == actions_of(folder / name), case


@pytest.mark.slow
def test_the_card_of_a_push_shows_results_and_figures(hub, pushed, folder):
    commits = list(hub.repositories["model", "user/pushed"].commits.values())
    metadata, text = card_parts(commits[1]["README.md"].decode())
    assert metadata["datasets"] == ["user/data"]
    assert metadata["license"] == "mit"
    assert {"pf2mp", "maze"} <= set(metadata["tags"])
    assert (folder / "results/table.md").read_text().strip() in text
    assert "![a way](figures/a_way.png)" in text
    assert "https://huggingface.co/user/pushed/resolve/main/figures/rollout.mp4" in text
    assert "mujoco 3." in text
    assert "--env.type=pf2mp_maze" in text  # of the results, as there is no training configuration
    assert row_of(text, "anchors M") == "48 demonstrated actions"
    _, text = card_parts(commits[2]["README.md"].decode())
    assert row_of(text, "training") == "steps: 7, batch size: 3"
    assert row_of(text, "dataset") == "`local/data`, not published"


@pytest.mark.slow
def test_only_the_files_of_a_checkpoint_are_published(hub, pushed):
    latest = hub.repositories["model", "user/pushed"].files()
    names = {name for name in latest if "/" not in name}
    assert names == {".gitattributes", "README.md", "train_config.json", *CHECKPOINT_FILES}
    assert not [name for name in latest if name.startswith("training_state")]


@pytest.mark.slow
def test_a_branch_leaves_main_alone(hub, pushed):
    repository = hub.repositories["model", "user/pushed"]
    assert json.loads(repository.files()["config.json"])["type"] == "dppf"
    assert json.loads(repository.files("unguided")["config.json"])["type"] == "fmp"


@pytest.mark.slow
def test_a_private_push_is_private(hub, pushed):
    assert pushed["private"][0] == 0
    assert hub.repositories["model", "user/secret"].is_private
    assert not hub.repositories["model", "user/pushed"].is_private


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("private_on_public", "user/pushed cannot be published: it is public already"),
        ("no_token", "user/nobody cannot be published: .*(?i:log in|login|token)"),
        ("wrong_token", "user/nobody cannot be published: .*(?i:invalid)"),
        ("reading_token", "user/nobody cannot be published: .*403"),
        ("other_user", "user/nobody cannot be published: .*403"),
        ("other_users_repository", "user/pushed cannot be published: .*403"),
    ],
)
def test_a_push_that_is_not_allowed_ends_in_one_line(hub, pushed, case, message):
    code, said = pushed[case]
    assert code == 1
    assert "Traceback" not in said
    assert re.match(f"error: {message}", said.strip().splitlines()[-1])
    assert ("model", "user/nobody") not in hub.repositories


# From demonstrations to a policy that is trained further, all of it by way of the Hub.

TRAINING_OPTIONS = (
    "--policy.device=cpu",
    "--policy.horizon=8",
    "--policy.n_action_steps=8",
    "--policy.down_dims=[8,16]",
    "--policy.diffusion_step_embed_dim=16",
)
LOOP_OPTIONS = ("--batch_size=8", "--num_workers=0", "--steps=4", "--seed=3")


@pytest.fixture(scope="module")
def chain(hub: HubServer, folder: Path) -> Path:
    """Collects and publishes demonstrations, trains on them and publishes the policy, and trains that one further."""
    home = folder / "chain"
    home.mkdir()
    collect = (
        "from lerobot_pf2mp.commands import cli; import sys; sys.argv[0] = 'pf2mp-collect'; cli.collect()"
    )
    for seed, n_episodes in ((1, 6), (0, 5)):  # the second time over the first
        said = run(
            hub,
            home,
            sys.executable,
            "-c",
            collect,
            "--task=maze_umaze",
            "--repo_id=user/umaze",
            "--push_to_hub=true",
            f"--n_episodes={n_episodes}",
            "--n_steps=8",
            f"--seed={seed}",
            "--root=local_copy",
            "--overwrite=true",
            token="writes",
        )
        assert f"Published it at {hub.url}/datasets/user/umaze." in said
        if n_episodes == 6:  # a file that the second state does not have
            hub.repositories["dataset", "user/umaze"].files()["data/chunk-000/file-001.parquet"] = b"old"
    run(
        hub,
        home,
        BIN / "lerobot-train",
        "--policy.type=pf2mp",
        "--dataset.repo_id=user/umaze",
        "--policy.push_to_hub=true",
        "--policy.repo_id=user/trained",
        "--policy.private=true",
        "--output_dir=training",
        *TRAINING_OPTIONS,
        *LOOP_OPTIONS,
        token="writes",
    )
    return home


@pytest.mark.slow
def test_a_published_dataset_is_read_back_as_it_was_written(hub, chain):
    repository = hub.repositories["dataset", "user/umaze"]
    assert repository.tags == {"v3.0": repository.branches["main"]}
    assert len(repository.commits) == 3  # the Hub's own, and one for each time
    local = {
        path.relative_to(chain / "local_copy").as_posix(): path.read_bytes()
        for path in (chain / "local_copy").rglob("*")
        if path.is_file()
    }
    published = dict(repository.files())
    assert published.keys() - local.keys() == {".gitattributes"}
    assert [name for name in local if local[name] != published[name]] == ["README.md"]
    metadata, text = card_parts(published["README.md"].decode())
    assert metadata["configs"] == [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    assert "LeRobot" in metadata["tags"]
    assert text.strip() == card_parts(local["README.md"].decode())[1].strip()
    # LeRobot has read it to train.
    dataset = LeRobotDataset("user/umaze", root=chain / "local_copy")
    points = load_file(chain / "training/checkpoints/last/pretrained_model" / FIELD_FILE)["points"]
    _, _, postprocess = load_policy(chain / "training/checkpoints/last/pretrained_model", device="cpu")
    actions = np.array(dataset.hf_dataset.with_format("numpy")["action"])
    distances = np.linalg.norm(postprocess(points).numpy()[:, None] - actions, axis=-1)
    assert (len(actions), distances.min(axis=1).max() < 1e-5) == (40, True)


@pytest.mark.slow
def test_lerobot_train_publishes_the_policy_with_our_card(hub, chain):
    repository = hub.repositories["model", "user/trained"]
    assert repository.is_private
    files = repository.files()
    assert set(files) == {".gitattributes", "README.md", "train_config.json", *CHECKPOINT_FILES}
    local = chain / "training/checkpoints/last/pretrained_model"
    for name in CHECKPOINT_FILES:
        assert files[name] == (local / name).read_bytes(), name
    metadata, text = card_parts(files["README.md"].decode())
    assert metadata["datasets"] == ["user/umaze"]
    assert row_of(text, "dataset").endswith(": 5 episodes, 40 frames")
    assert row_of(text, "training") == "steps: 4, batch size: 8, seed: 3"
    anchors = len(load_file(local / FIELD_FILE)["points"])
    assert row_of(text, "anchors M") == f"{anchors} demonstrated actions"


@pytest.mark.slow
def test_a_policy_that_lerobot_train_has_published_loads_and_its_first_commit_does_not(hub, chain):
    # LeRobot publishes the weights in one commit, the processors in two more.
    repository = hub.repositories["model", "user/trained"]
    weights_only = next(sha for sha, files in repository.commits.items() if "model.safetensors" in files)
    assert FIELD_FILE not in repository.commits[weights_only]
    cases = {
        "whole": ["load", "reads", "user/trained"],
        "part": ["load", "reads", "user/trained", weights_only],
    }
    out = run_cases(hub, chain, cases)
    assert out["whole"][0] == actions_of(chain / "training/checkpoints/last/pretrained_model")
    assert re.match(
        "(?s)OSError: .* must hold its processors, got user/trained without policy_preprocessor.json",
        out["part"][0],
    )


@pytest.mark.slow
def test_lerobot_eval_takes_policy_and_field_from_the_hub(hub, chain):
    local = chain / "training/checkpoints/last/pretrained_model"
    outcomes = []
    for path in ("user/trained", local):
        output = chain / f"eval_{len(outcomes)}"
        run(
            hub,
            chain,
            BIN / "lerobot-eval",
            f"--policy.path={path}",
            "--env.type=pf2mp_maze",
            "--env.task=MazeUMaze-v0",
            "--env.episode_length=8",
            "--eval.n_episodes=2",
            "--eval.batch_size=2",
            "--eval.use_async_envs=false",
            f"--output_dir={output}",
            token="reads",
        )
        outcomes.append(json.loads((output / "eval_info.json").read_text())["per_task"][0]["metrics"])
    from_the_hub, from_the_disk = outcomes
    assert from_the_hub["sum_rewards"] == from_the_disk["sum_rewards"]
    assert from_the_hub["successes"] == from_the_disk["successes"]


@pytest.mark.slow
def test_lerobot_train_goes_on_from_the_hub(hub, chain):
    run(
        hub,
        chain,
        BIN / "lerobot-train",
        "--policy.path=user/trained",
        "--dataset.repo_id=user/umaze",
        "--policy.push_to_hub=true",
        "--policy.repo_id=user/further",
        "--output_dir=further",
        *LOOP_OPTIONS,
        token="writes",
    )
    old, new = (hub.repositories["model", name].files() for name in ("user/trained", "user/further"))
    assert new.keys() == old.keys()
    assert new["model.safetensors"] != old["model.safetensors"]
    assert FIELD_FILE in new
    assert "lerobot-eval --policy.path=user/further" in new["README.md"].decode()


# Datasets that cannot be published.


def test_a_dataset_is_not_made_if_it_cannot_be_published(tmp_path, refused):
    root = tmp_path / "data"
    collect = ("collect", "--task=maze_umaze", f"--root={root}")
    convert = ("convert", f"--source.path={tmp_path}/none.hdf5", f"--root={root}")
    for command in (collect, convert):
        assert "must be the name of a repository on the Hub, user/name, got None" in refused(
            *command, "--push_to_hub=true"
        )
        for name in ("umaze", "local/umaze", "user/a/b"):
            line = refused(*command, "--push_to_hub=true", f"--repo_id={name}")
            assert f"user/name, got {name}" in line
        # These tests run without a network, which is found out before anything is made.
        assert "user/umaze cannot be published: " in refused(
            *command, "--push_to_hub=true", "--repo_id=user/umaze"
        )
        assert "--private needs --push_to_hub=true" in refused(*command, "--private=true")
    assert not root.exists()


@pytest.mark.slow
def test_a_dataset_that_the_hub_refuses_stays_on_the_disk(hub, folder):
    home = folder / "refused"
    home.mkdir()
    arguments = ["collect", "--task=maze_umaze", "--n_episodes=2", "--n_steps=8", "--push_to_hub=true"]
    cases = {
        "without_login": ["command", "", *arguments, "--repo_id=user/refused", "--root=first"],
        "of_another": ["command", "others", *arguments, "--repo_id=user/refused", "--root=second"],
    }
    out = run_cases(hub, home, cases)
    for case, message in (
        ("without_login", "user/refused cannot be published: .*(?i:log in|login|token)"),
        ("of_another", "the dataset was written to second: user/refused cannot be published: .*403"),
    ):
        code, said = out[case]
        assert code == 1
        assert re.match(f"error: {message}", said.strip().splitlines()[-1])
    assert not (home / "first").exists()
    assert (home / "second/meta/info.json").is_file()
    assert ("dataset", "user/refused") not in hub.repositories
