# SPDX-License-Identifier: Apache-2.0
"""A potential field for a policy that is trained already, by `fit_field` and by pf2mp-fit-field."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import PIL.Image
import pytest
import torch
from draccus.utils import ParsingError
from forked_commands import run_well
from hub_server import HubServer
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class, make_policy
from lerobot.policies.gaussian_actor.configuration_gaussian_actor import GaussianActorConfig
from lerobot.processor import DataProcessorPipeline
from safetensors.torch import load_file
from torch import Tensor

from lerobot_pf2mp import load_policy
from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.dataset_tools.writing.lerobot_writer import DatasetSpec, write_dataset
from lerobot_pf2mp.fit_field import GUIDED_TYPES, fit_field
from lerobot_pf2mp.loading import loaded_demonstrations
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.process import renaming

BIN = Path(sys.executable).parent
SECONDS = 600  # for a command, on a machine that is busy with other things
FIELD_FILE = "policy_preprocessor_step_4_potential_field.safetensors"
STATE, ENV, ACTION = "observation.state", "observation.environment_state", "action"
LENGTHS = (12, 1, 7, 15, 20)
N_FRAMES = sum(LENGTHS)
FEATURES: dict[str, dict[str, Any]] = {
    key: {"dtype": "float32", "shape": (2,), "names": ["x", "y"]} for key in (STATE, ENV, ACTION)
}
SMALL: dict[str, Any] = {
    "device": "cpu",
    "down_dims": (8, 16),
    "horizon": 8,
    "n_action_steps": 4,
    "diffusion_step_embed_dim": 16,
    "input_features": {
        STATE: PolicyFeature(FeatureType.STATE, (2,)),
        ENV: PolicyFeature(FeatureType.ENV, (2,)),
    },
    "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
}
STANDARDISED = dict.fromkeys(("VISUAL", "STATE", "ENV", "ACTION"), NormalizationMode.MEAN_STD)
OTHER_GUIDANCE: dict[str, Any] = {
    "guidance_scale": 0.3,
    "guidance_integrator": "euler",
    "guidance_point": "end",
    "n_field_points": 20,
    "field_bandwidth": "scott",
    "field_threshold_quantile": 0.2,
    "field_alpha": -0.7,
}
CHECKPOINTS: dict[str, tuple[str, dict[str, Any]]] = {
    "diffusion": ("diffusion", {"n_obs_steps": 1, "num_train_timesteps": 20}),
    "diffusion_of_two_frames": (
        "diffusion",
        {
            "n_obs_steps": 2,
            "noise_scheduler_type": "DDIM",
            "num_inference_steps": 3,
            "normalization_mapping": STANDARDISED,
        },
    ),
    "fmp": ("fmp", {}),
    "fmp_of_two_frames": ("fmp", {"n_obs_steps": 2, "use_ema": False, "normalization_mapping": STANDARDISED}),
    "dppf": ("dppf", {"n_obs_steps": 2, "num_inference_steps": 3, **OTHER_GUIDANCE}),
    "pf2mp": ("pf2mp", {"num_inference_steps": 3, "optimizer_lr": 0.123, **OTHER_GUIDANCE}),
}
every_checkpoint = pytest.mark.parametrize("name", CHECKPOINTS)

Make = Callable[[str], Path]


def write(folder: Path, seed: int, scale: float, features: dict[str, Any] = FEATURES) -> Path:
    """A dataset of episodes of unequal length, of actions that are all different."""
    rng = np.random.default_rng(seed)
    episodes = [
        {
            key: scale * rng.normal(size=(length, *f["shape"])).astype(np.float32)
            for key, f in features.items()
        }
        for length in LENGTHS
    ]
    write_dataset(folder, DatasetSpec(f"local/{folder.name}", 10, features, "Do it.", "A card."), episodes)
    return folder


def dataset_of(data: Path, **options: Any) -> LeRobotDataset:
    return LeRobotDataset(f"local/{data.name}", root=data, **options)


def metadata_of(data: Path) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata(f"local/{data.name}", root=data)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data that policies have learned from, and other data, three times as wide, to fit fields to."""
    folder = tmp_path_factory.mktemp("fit_field")
    write(folder / "learned", seed=0, scale=1.0)
    write(folder / "shown", seed=1, scale=3.0)
    return folder


@pytest.fixture(scope="module")
def shown(folder: Path) -> Path:
    return folder / "shown"


@pytest.fixture(scope="module")
def checkpoint(folder: Path) -> Make:
    """Makes each checkpoint once: random weights, and the field of a first batch where there is one."""

    def make(name: str) -> Path:
        path = folder / name
        if not path.exists():
            torch.manual_seed(1)
            policy_type, options = CHECKPOINTS[name]
            config = PreTrainedConfig.get_choice_class(policy_type)(**{**SMALL, **options})
            stats = metadata_of(folder / "learned").stats
            policy = get_policy_class(policy_type)(config, dataset_stats=stats)
            preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=stats)
            move_the_average(policy)
            if "guidance_scale" in vars(config):
                policy.train()
                policy(preprocessor(next(batches(policy.config, folder / "learned"))))
            for part in (policy, preprocessor, postprocessor):
                part.save_pretrained(path)
        return path

    return make


@pytest.fixture(scope="module")
def fitted(checkpoint: Make, folder: Path, shown: Path) -> Make:
    """Fits a field to each checkpoint once, without options."""

    def make(name: str) -> Path:
        path = folder / f"fitted_{name}"
        return path if path.exists() else fit(checkpoint(name), path, shown)

    return make


def move_the_average(policy: Any) -> None:
    """Makes the network and its moving average, if it has one, differ; the first update only copies."""
    for _ in range(2 if getattr(policy, "ema", None) else 0):
        with torch.no_grad():
            for weight in policy.network.parameters():
                weight.add_(0.1 * torch.randn_like(weight))
        policy.update()


def batches(config: PreTrainedConfig, data: Path) -> Iterator[dict[str, Any]]:
    """The batches of an epoch, as lerobot-train loads them."""
    delta_timestamps = resolve_delta_timestamps(config, metadata_of(data))
    dataset = dataset_of(data, delta_timestamps=delta_timestamps)
    yield from torch.utils.data.DataLoader(dataset, batch_size=8, shuffle=True)


def fit(checkpoint: Path, output: Path, data: Path, **options: Any) -> Path:
    fit_field(checkpoint, output, repo_id=f"local/{data.name}", root=data, **options)
    return output


def actions_of(loaded: tuple[Any, Any, Any]) -> Tensor:
    """Six actions, more than a chunk, for three sequences of observations and noise that are always the same."""
    policy, preprocess, postprocess = loaded
    rng = torch.Generator().manual_seed(7)
    stream = [{key: torch.rand(3, 2, generator=rng) for key in (STATE, ENV)} for _ in range(6)]
    policy.reset()
    torch.manual_seed(8)
    return torch.stack([postprocess(policy.select_action(preprocess(batch))) for batch in stream])


def config_of(checkpoint: Path) -> dict[str, Any]:
    return json.loads((checkpoint / "config.json").read_text())


def steps_of(checkpoint: Path) -> list[dict[str, Any]]:
    return json.loads((checkpoint / "policy_preprocessor.json").read_text())["steps"]


def field_of(checkpoint: Path) -> dict[str, Tensor]:
    return load_file(checkpoint / FIELD_FILE)


def assert_same_tensors(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert actual.keys() == expected.keys()
    assert [key for key in expected if not torch.equal(actual[key], expected[key])] == []


def actions_in(data: Path) -> np.ndarray:
    """The dataset's actions, (N_FRAMES, 2), in the order of its frames."""
    return np.array(dataset_of(data).hf_dataset.with_format("numpy")[ACTION])


def frames_of(checkpoint: Path, data: Path) -> list[int]:
    """The frames of the dataset whose actions are the field's points, in ascending order.

    The points are compared in the actions' own units, into which the checkpoint's postprocessor brings them.
    """
    _, _, postprocess = load_policy(checkpoint, device="cpu")
    points = postprocess(field_of(checkpoint)["points"]).numpy()
    distances = np.linalg.norm(points[:, None] - actions_in(data), axis=-1)
    assert distances.min(axis=1).max() < 1e-5
    return sorted(distances.argmin(axis=1).tolist())


def everything_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def contents_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def error_of(stderr: str) -> str:
    """The only line that starts with "error:", which must be the last."""
    assert "Traceback" not in stderr
    lines = stderr.strip().splitlines()
    assert [line for line in lines if line.startswith("error:")] == lines[-1:]
    return lines[-1]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Runs pf2mp-fit-field in this process."""

    def command(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["pf2mp-fit-field", *arguments])
        cli.fit_field()

    return command


@pytest.fixture
def refused(command: Callable[..., None], capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs pf2mp-fit-field in this process and returns the line with which it ends."""

    def refused(*arguments: str) -> str:
        capfd.readouterr()
        with pytest.raises(SystemExit, match="1"):
            command(*arguments)
        captured = capfd.readouterr()
        assert "Wrote" not in captured.out
        return error_of(captured.err)

    return refused


def arguments(checkpoint: Path, data: Path, output: Path) -> list[str]:
    return [
        f"--policy.path={checkpoint}",
        f"--dataset.repo_id=local/{data.name}",
        f"--dataset.root={data}",
        f"--output_dir={output}",
    ]


# What becomes of a policy.


def test_diffusion_policies_become_dppf_and_flow_matching_policies_pf2mp():
    assert GUIDED_TYPES == {
        "diffusion": "dppf",
        "dppf": "dppf",
        "fmp": "pf2mp",
        "pf2mp": "pf2mp",
        "guarded": "guarded",
    }


@pytest.mark.slow
@every_checkpoint
def test_the_new_checkpoint_is_of_the_guided_type_and_holds_one_field(name, checkpoint, shown, tmp_path):
    old, new = checkpoint(name), tmp_path / "new"
    config = fit_field(old, new, repo_id="local/shown", root=shown)
    expected = GUIDED_TYPES[CHECKPOINTS[name][0]]
    assert (config.type, config_of(new)["type"]) == (expected, expected)
    assert everything_in(new) == sorted({*everything_in(old), FIELD_FILE})
    assert [step["registry_name"] for step in steps_of(new)] == [
        "rename_observations_processor",
        "to_batch_processor",
        "device_processor",
        "normalizer_processor",
        "potential_field",
    ]
    assert steps_of(new)[:4] == steps_of(old)[:4]
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


@pytest.mark.slow
@every_checkpoint
def test_the_weights_are_bit_for_bit_those_of_the_old_checkpoint(name, checkpoint, fitted):
    weights = load_file(fitted(name) / "model.safetensors")
    assert_same_tensors(weights, load_file(checkpoint(name) / "model.safetensors"))
    if name in ("fmp", "pf2mp"):
        average = {key: weight for key, weight in weights.items() if key.startswith("ema.module.")}
        assert any(not torch.equal(average[k], weights[k.replace("ema.module", "network")]) for k in average)


@pytest.mark.slow
@every_checkpoint
def test_only_guidance_changes_what_the_policy_does(name, checkpoint, fitted):
    off = {"guidance_scale": 0, "max_plans": 1} if "guidance_scale" in config_of(checkpoint(name)) else {}
    before = actions_of(load_policy(checkpoint(name), device="cpu", **off))
    assert torch.equal(
        actions_of(load_policy(fitted(name), device="cpu", guidance_scale=0, max_plans=1)), before
    )
    guided = actions_of(load_policy(fitted(name), device="cpu"))
    assert guided.isfinite().all()
    assert not torch.equal(guided, before)


@every_checkpoint
def test_lerobots_own_functions_load_the_guided_policy(name, fitted, shown):
    config = PreTrainedConfig.from_pretrained(fitted(name))
    config.pretrained_path = fitted(name)
    policy = make_policy(config, ds_meta=metadata_of(shown))
    loaded = (policy, *make_pre_post_processors(config, pretrained_path=str(fitted(name))))
    assert torch.equal(actions_of(loaded), actions_of(load_policy(fitted(name), device="cpu")))


@every_checkpoint
def test_every_option_of_the_old_checkpoint_is_kept(name, checkpoint, fitted):
    old, new = config_of(checkpoint(name)), config_of(fitted(name))
    assert (old.pop("type"), old.pop("pretrained_path")) == (CHECKPOINTS[name][0], None)
    assert {key: new[key] for key in old} == old
    assert new["pretrained_path"] == str(checkpoint(name))


@pytest.mark.parametrize("name", ["diffusion", "fmp"])
def test_a_policy_without_guidance_gets_that_of_the_defaults(name, fitted):
    config = PreTrainedConfig.from_pretrained(fitted(name))
    default = type(config)(device="cpu")
    assert {key: getattr(config, key) for key in OTHER_GUIDANCE} == {
        key: getattr(default, key) for key in OTHER_GUIDANCE
    }


def test_the_device_of_the_old_checkpoint_is_kept(checkpoint, shown, tmp_path, monkeypatch):
    # The field is fitted on the CPU, but later training and evaluation are not to be.
    monkeypatch.setattr("lerobot.configs.policies.is_torch_device_available", lambda device: True)
    old = tmp_path / "old"
    shutil.copytree(checkpoint("diffusion"), old)
    for file in ("config.json", "policy_preprocessor.json"):
        text = (old / file).read_text()
        assert '"device": "cpu"' in text
        (old / file).write_text(text.replace('"device": "cpu"', '"device": "cuda"'))
    new = fit(old, tmp_path / "new", shown)
    assert config_of(new)["device"] == "cuda"
    assert steps_of(new)[:4] == steps_of(old)


@pytest.mark.parametrize("name", ["diffusion", "fmp", "dppf", "pf2mp"])
def test_options_that_are_given_take_effect_and_the_others_stay(name, checkpoint, fitted, shown, tmp_path):
    given = {
        "guidance_scale": 0.25,
        "n_field_points": 11,
        "field_bandwidth": 0.4,
        "field_action_dims": (1,),
        "field_alpha": -2.0,
    }
    new = fit(checkpoint(name), tmp_path / "new", shown, options=given)
    config, others = config_of(new), config_of(fitted(name))
    assert config == {**others, **given, "field_action_dims": [1]}
    points = field_of(new)["points"]
    assert torch.equal(points, field_of(fitted(name))["points"][:11, 1:])
    policy, preprocess, _ = load_policy(new, device="cpu")
    batch = preprocess({STATE: torch.zeros(1, 2), ENV: torch.zeros(1, 2)})
    guide = policy.guidance.guide(batch, torch.device("cpu"))
    assert (guide.dims.tolist(), guide.guide.scale) == ([1], 0.25)
    assert torch.equal(guide.guide.field.anchors, points)
    assert (guide.guide.field.bandwidth, guide.guide.field.alpha) == (0.4, -2.0)


# The field.


@pytest.mark.slow
@every_checkpoint
def test_the_anchors_are_the_datasets_actions_in_the_normalisation_of_the_checkpoint(
    name, checkpoint, shown, tmp_path
):
    new = fit(checkpoint(name), tmp_path / "new", shown, options={"n_field_points": 3000})
    assert frames_of(new, shown) == list(range(N_FRAMES))
    # In the normalisation of the dataset they would be others.
    config = PreTrainedConfig.from_pretrained(new)
    _, of_the_dataset = make_pre_post_processors(config, dataset_stats=metadata_of(shown).stats)
    _, _, of_the_checkpoint = load_policy(new, device="cpu")
    points = field_of(new)["points"]
    assert (of_the_dataset(points) - of_the_checkpoint(points)).abs().max() > 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["diffusion_of_two_frames", "fmp", "pf2mp"])
def test_the_field_is_bit_for_bit_the_one_that_training_on_all_frames_leaves(
    name, checkpoint, folder, shown, tmp_path
):
    new = fit(checkpoint(name), tmp_path / "new", shown, options={"n_field_points": 30})
    stats = metadata_of(folder / "learned").stats
    config = PreTrainedConfig.from_pretrained(new)
    policy = get_policy_class(config.type)(config, dataset_stats=stats).train()
    preprocess, _ = make_pre_post_processors(config, dataset_stats=stats)
    for batch in batches(config, shown):
        policy(preprocess(batch))
    trained, fitted = preprocess.steps[-1].state_dict(), field_of(new)
    assert trained["points"].shape == (30, 2)
    assert (trained.pop("dataset_id").numel(), fitted.pop("dataset_id").numel()) == (32, 0)
    assert_same_tensors(fitted, trained)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dppf", "pf2mp"])
def test_the_new_field_replaces_the_old_one(name, checkpoint, folder, shown, tmp_path):
    # The old field is fitted to frames that the new one does not see.
    old = fit(checkpoint(name), tmp_path / "old", folder / "learned")
    new = fit(old, tmp_path / "new", shown, episodes=[4])
    expected = fit(checkpoint(name), tmp_path / "expected", shown, episodes=[4])
    assert len(frames_of(new, shown)) == 20
    assert contents_of(new).keys() == contents_of(expected).keys()
    for file in contents_of(expected).keys() - {"config.json"}:  # which names the checkpoint it was made from
        assert contents_of(new)[file] == contents_of(expected)[file], file


@pytest.mark.parametrize("episodes", [[0, 2], [3, 1], [4]])
def test_the_field_covers_only_the_episodes_that_are_asked_for(episodes, checkpoint, fitted, shown, tmp_path):
    new = fit(checkpoint("diffusion"), tmp_path / "new", shown, episodes=episodes)
    ends = np.cumsum(LENGTHS)
    expected = [frame for i in sorted(episodes) for frame in range(ends[i] - LENGTHS[i], ends[i])]
    assert frames_of(new, shown) == expected
    some, all_ = field_of(new), field_of(fitted("diffusion"))
    is_among = torch.isin(all_["ranks"], some["ranks"])
    assert torch.equal(some["ranks"], all_["ranks"][is_among])
    assert torch.equal(some["points"], all_["points"][is_among])


def test_a_dataset_that_is_read_in_blocks_gives_the_same_field(
    checkpoint, fitted, shown, tmp_path, monkeypatch
):
    expected = contents_of(fitted("fmp"))
    monkeypatch.setattr("lerobot_pf2mp.fit_field._FRAMES_AT_ONCE", 7)
    assert contents_of(fit(checkpoint("fmp"), tmp_path / "new", shown)) == expected


def test_a_dataset_without_states_calibrates_plans_from_their_first_actions(checkpoint, tmp_path):
    data = write(tmp_path / "stateless", 1, 3.0, {key: FEATURES[key] for key in (ENV, ACTION)})
    policy, preprocessor, _ = load_policy(fit(checkpoint("fmp"), tmp_path / "new", data))
    demonstrations = loaded_demonstrations(preprocessor)
    settings = policy.config.field_settings
    assert not demonstrations.starts_at_state(settings)
    assert (
        demonstrations.plan_threshold(settings, policy.config.n_action_steps, 0.3).n_plans == 4
    )  # one is too short


@pytest.mark.slow
def test_images_of_the_dataset_are_not_decoded(checkpoint, tmp_path, monkeypatch):
    front = "observation.images.front"
    features = {**FEATURES, front: {"dtype": "image", "shape": (8, 8, 3), "names": None}}
    data = tmp_path / "filmed"
    recorder = LeRobotDataset.create("local/filmed", 10, features, root=data, use_videos=False)
    for _ in range(4):
        frame = {key: torch.randn(2).numpy() for key in FEATURES}
        image = torch.randint(256, (8, 8, 3), dtype=torch.uint8).numpy()
        recorder.add_frame({**frame, front: image, "task": "Do it."})
    recorder.save_episode()
    recorder.finalize()

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("an image was decoded")

    monkeypatch.setattr(PIL.Image, "open", refuse)
    with pytest.raises(AssertionError, match="an image was decoded"):
        dataset_of(data)[0]
    assert frames_of(fit(checkpoint("diffusion"), tmp_path / "new", data), data) == [0, 1, 2, 3]


# What comes after.


@pytest.mark.slow
def test_later_training_starts_the_field_afresh(folder, fitted, shown, tmp_path):
    # On other data, on the data of the field, and on those of the policy: nothing fitted may remain.
    for data in (folder / "learned", shown):
        config = PreTrainedConfig.from_pretrained(fitted("fmp"))
        config.pretrained_path = fitted("fmp")
        policy = make_policy(config, ds_meta=metadata_of(data)).train()
        preprocess, _ = make_pre_post_processors(config, pretrained_path=str(fitted("fmp")))
        batch = next(batches(config, data))
        n_actions = (~batch["action_is_pad"]).sum()
        policy(preprocess(batch))
        field = preprocess.steps[-1].state_dict()
        assert len(field["dataset_id"]) == 32
        assert 0 < len(field["points"]) <= n_actions < N_FRAMES


@pytest.mark.slow
def test_lerobot_train_goes_on_from_the_new_checkpoint(fitted, shown, tmp_path):
    run_well(
        "lerobot-train",
        f"--policy.path={fitted('diffusion_of_two_frames')}",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=local/shown",
        f"--dataset.root={shown}",
        "--batch_size=2",
        "--num_workers=0",
        "--steps=2",
        f"--output_dir={tmp_path / 'training'}",
    )
    trained = tmp_path / "training/checkpoints/last/pretrained_model"
    assert config_of(trained)["type"] == "dppf"
    # Two batches of two chunks of eight actions, now in the normalisation of these data.
    assert 0 < len(frames_of(trained, shown)) <= 32
    config = PreTrainedConfig.from_pretrained(trained)
    _, of_the_dataset = make_pre_post_processors(config, dataset_stats=metadata_of(shown).stats)
    _, _, of_the_checkpoint = load_policy(trained, device="cpu")
    points = field_of(trained)["points"]
    torch.testing.assert_close(of_the_dataset(points), of_the_checkpoint(points))


# Errors, and what they leave behind.


def damaged(checkpoint: Path, copy: Path, damage: Callable[[Path], Any]) -> Path:
    shutil.copytree(checkpoint, copy)
    damage(copy)
    return copy


def test_a_policy_that_plans_no_chunks_is_refused(shown, tmp_path):
    GaussianActorConfig(device="cpu").save_pretrained(tmp_path / "actor")
    with pytest.raises(ParsingError, match="must plan chunks of actions, got gaussian_actor"):
        fit(tmp_path / "actor", tmp_path / "new", shown)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("shape", [3, None])
def test_a_dataset_with_other_actions_is_refused(shape, checkpoint, tmp_path):
    features = {key: FEATURES[key] for key in (STATE, ENV)}
    if shape:
        features[ACTION] = {**FEATURES[ACTION], "shape": (shape,), "names": None}
    data = write(tmp_path / "other", seed=0, scale=1.0, features=features)
    got = r"\(3,\)" if shape else r"\(\)"
    message = rf"the dataset's action must have the policy's shape \(2,\), got {got}"
    with pytest.raises(ValueError, match=message):
        fit(checkpoint("diffusion"), tmp_path / "new", data)
    assert [path.name for path in tmp_path.iterdir()] == ["other"]


def test_a_checkpoint_that_does_not_exist_is_refused(shown, tmp_path):
    with pytest.raises(
        FileNotFoundError, match="must be a checkpoint's pretrained_model folder or a repos.*none"
    ):
        fit(tmp_path / "none", tmp_path / "new", shown)
    assert everything_in(tmp_path) == []


@pytest.mark.parametrize(
    "file", ["policy_preprocessor.json", "policy_postprocessor.json", "model.safetensors"]
)
def test_a_checkpoint_that_lacks_a_file_is_refused(file, checkpoint, shown, tmp_path):
    old = damaged(checkpoint("diffusion"), tmp_path / "old", lambda path: (path / file).unlink())
    before = everything_in(tmp_path)
    with pytest.raises(OSError, match=f"{old} cannot be loaded: .*{file}"):
        fit(old, tmp_path / "new", shown)
    assert everything_in(tmp_path) == before


def test_actions_that_are_not_finite_are_refused(checkpoint, tmp_path):
    data = write(tmp_path / "data", seed=0, scale=1.0)
    (file,) = (data / "data").rglob("*.parquet")
    table = pd.read_parquet(file)
    table.at[3, ACTION] = np.array([np.nan, 0], dtype=np.float32)
    table.to_parquet(file)
    with pytest.raises(ValueError, match="actions must be finite, got NaN"):
        fit(checkpoint("diffusion"), tmp_path / "new", data)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_an_existing_checkpoint_is_replaced_only_if_asked_to(checkpoint, fitted, shown, tmp_path):
    new = fit(checkpoint("fmp"), tmp_path / "new", shown, options={"n_field_points": 5})
    (new / "policy_preprocessor_step_9_old.safetensors").write_text("left over")
    before = contents_of(new)
    with pytest.raises(
        FileExistsError, match="exists already: choose another --output_dir, or pass --overwrite"
    ):
        fit(checkpoint("fmp"), new, shown)
    assert contents_of(new) == before
    fit(checkpoint("fmp"), new, shown, overwrite=True)
    assert contents_of(new) == contents_of(fitted("fmp"))
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_a_checkpoint_can_be_replaced_by_itself_with_a_field(checkpoint, fitted, shown, tmp_path):
    new = damaged(checkpoint("pf2mp"), tmp_path / "new", lambda path: None)
    fit(new, new, shown, overwrite=True)
    assert_same_tensors(field_of(new), field_of(fitted("pf2mp")))
    assert contents_of(new)["model.safetensors"] == contents_of(fitted("pf2mp"))["model.safetensors"]


def test_a_folder_that_is_no_checkpoint_is_never_replaced(checkpoint, shown, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/chapter.tex").write_text("precious")
    with pytest.raises(
        FileExistsError, match="is no checkpoint, it holds no config.json, and will not be overwritten"
    ):
        fit(checkpoint("fmp"), tmp_path / "thesis", shown, overwrite=True)
    assert contents_of(tmp_path) == {"thesis/chapter.tex": b"precious"}


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize(
    "where",
    [
        (DemonstratedActions, "observe"),
        (DemonstratedActions, "state_dict"),
        (DataProcessorPipeline, "save_pretrained"),
        (renaming, "_rename"),
    ],
    ids=lambda where: where[1],
)
def test_a_failure_in_the_middle_leaves_everything_as_it_was(
    where, exists, checkpoint, fitted, shown, tmp_path, monkeypatch
):
    if exists:
        shutil.copytree(fitted("dppf"), tmp_path / "new")
    before = contents_of(tmp_path)
    calls = []
    original = getattr(*where)

    def fail(*arguments: Any, **options: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return original(*arguments, **options)

    monkeypatch.setattr(*where, fail)
    with pytest.raises(KeyboardInterrupt, match="^$"):
        fit(checkpoint("fmp"), tmp_path / "new", shown, overwrite=True)
    assert calls
    assert contents_of(tmp_path) == before
    assert [path.name for path in tmp_path.iterdir()] == (["new"] if exists else [])


@pytest.mark.slow
def test_a_failure_leaves_no_empty_folders(checkpoint, tmp_path):
    data = write(tmp_path / "data", seed=0, scale=1.0, features={key: FEATURES[key] for key in (STATE, ENV)})
    with pytest.raises(ValueError, match="the dataset's action must have"):
        fit(checkpoint("fmp"), tmp_path / "made/on/the/way", data)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize("root", ["none", "made/on/the/way"])
def test_a_dataset_that_does_not_exist_does_not_appear_as_an_empty_folder(root, checkpoint, tmp_path):
    with pytest.raises(OSError, match=f"the dataset local/{Path(root).name} in .*{root} cannot be read"):
        fit(checkpoint("fmp"), tmp_path / "new", tmp_path / root)
    assert everything_in(tmp_path) == []


def test_a_folder_that_is_no_dataset_stays_as_it_is(checkpoint, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/chapter.tex").write_text("precious")
    with pytest.raises(OSError, match="the dataset local/thesis in .*thesis cannot be read"):
        fit(checkpoint("fmp"), tmp_path / "new", tmp_path / "thesis")
    assert contents_of(tmp_path) == {"thesis/chapter.tex": b"precious"}


# The command.


def test_the_command_says_what_it_wrote(checkpoint, fitted, shown, tmp_path, command, capsys):
    command(*arguments(checkpoint("diffusion"), shown, tmp_path / "new"))
    assert capsys.readouterr().out.splitlines()[-1] == f"Wrote a dppf checkpoint to {tmp_path / 'new'}."
    assert contents_of(tmp_path / "new") == contents_of(fitted("diffusion"))


@pytest.mark.slow
def test_the_command_passes_every_option_on(checkpoint, shown, tmp_path, command):
    command(
        *arguments(checkpoint("pf2mp"), shown, tmp_path / "new"),
        "--policy.guidance_scale=0",
        "--policy.guidance_integrator=proximal",
        "--policy.n_field_points=7",
        "--policy.field_action_dims=[1,0]",
        "--policy.field_bandwidth=0.2",
        "--policy.field_threshold_quantile=0",
        "--policy.field_alpha=0",
        "--dataset.episodes=[0,3]",
    )
    options = {
        "guidance_scale": 0.0,
        "guidance_integrator": "proximal",
        "n_field_points": 7,
        "field_action_dims": (1, 0),
        "field_bandwidth": 0.2,
        "field_threshold_quantile": 0.0,
        "field_alpha": 0.0,
    }
    expected = fit(checkpoint("pf2mp"), tmp_path / "expected", shown, options=options, episodes=[0, 3])
    assert contents_of(tmp_path / "new") == contents_of(expected)
    command(
        *arguments(checkpoint("pf2mp"), shown, tmp_path / "new"),
        "--policy.field_bandwidth=silverman",
        "--overwrite=true",
    )
    assert config_of(tmp_path / "new")["field_bandwidth"] == "silverman"


def test_folders_below_the_home_folder_are_found(checkpoint, fitted, shown, tmp_path, monkeypatch, command):
    # A shell does not expand the ~ of --output_dir=~/new.
    home = tmp_path / "home"
    shutil.copytree(checkpoint("fmp"), home / "old")
    shutil.copytree(shown, home / "data/shown")
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(tmp_path)
    options = ["--policy.path=~/old", "--dataset.repo_id=local/shown", "--dataset.root=~/data/shown"]
    command(*options, "--output_dir=~/new")
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
    assert_same_tensors(field_of(home / "new"), field_of(fitted("fmp")))


@pytest.mark.parametrize("option", ["--policy.path", "--dataset.repo_id", "--output_dir"])
def test_a_missing_option_is_named(option, checkpoint, shown, tmp_path, refused):
    given = arguments(checkpoint("fmp"), shown, tmp_path / "new")
    left = [argument for argument in given if not argument.startswith(f"{option}=")]
    assert len(left) == 3
    assert refused(*left) == f"error: {option} must be given"
    assert everything_in(tmp_path) == []


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--policy.field_bandwidth=-1", "field_bandwidth must be finite and positive, got -1.0"),
        (
            "--policy.field_bandwidth=wide",
            "field_bandwidth must be one of .* or a positive number, got 'wide'",
        ),
        ("--policy.n_field_points=0", "n_field_points must be at least 1, got 0"),
        ("--policy.n_field_points=many", "`policy.n_field_points`: Could"),
        (
            "--policy.field_action_dims=[2]",
            r"field_action_dims must be below the action dimension 2, got \(2,\)",
        ),
        (
            "--policy.field_action_dims=[0,0]",
            r"field_action_dims must be distinct indices from 0 on, got \(0, 0\)",
        ),
        ("--policy.field_threshold_quantile=2", r"field_threshold_quantile must lie in \[0, 1\], got 2.0"),
        ("--policy.field_alpha=1", "field_alpha must be finite and at most 0, got 1.0"),
        ("--policy.guidance_scale=-1", "guidance_scale must be finite and at least 0, got -1.0"),
        ("--policy.guidance_integrator=rk4", "guidance_integrator must be one of .* got 'rk4'"),
        ("--dataset.episodes=first", "`dataset.episodes`: Could not"),
        ("--overwrite=perhaps", "`overwrite`: Couldn't parse 'perhaps' into a bool"),
    ],
)
def test_a_bad_value_ends_in_one_line_and_nothing_written(
    option, message, checkpoint, shown, tmp_path, refused
):
    line = refused(*arguments(checkpoint("diffusion"), shown, tmp_path / "new"), option)
    assert re.match(f"error: (.*: )?{message}", line), line
    assert everything_in(tmp_path) == []


DAMAGES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no_processors": (
        lambda path: [file.unlink() for file in path.glob("policy_*")],
        "policy_preprocessor.json",
    ),
    "no_preprocessor": (
        lambda path: (path / "policy_preprocessor.json").unlink(),
        "policy_preprocessor.json",
    ),
    "no_statistics": (
        lambda path: [file.unlink() for file in path.glob("policy_pre*.safetensors")],
        "policy_preprocessor_step_3_normalizer_processor.safetensors",
    ),
    "no_configuration": (lambda path: (path / "config.json").unlink(), "config.json not found in"),
    "half_a_configuration": (lambda path: (path / "config.json").write_text("{"), "old cannot be loaded: "),
    "truncated_weights": (
        lambda path: (path / "model.safetensors").write_bytes(b"half"),
        "old cannot be loaded: ",
    ),
    "another_policy": (
        lambda path: GaussianActorConfig(device="cpu").save_pretrained(path),
        "must plan chunks of actions, got gaussian_actor",
    ),
}


@pytest.mark.parametrize("damage", list(DAMAGES))
def test_a_damaged_checkpoint_ends_in_one_line_and_nothing_written(
    damage, checkpoint, shown, tmp_path, refused
):
    break_it, message = DAMAGES[damage]
    old = damaged(checkpoint("diffusion"), tmp_path / "old", break_it)
    before = everything_in(tmp_path)
    assert message in refused(*arguments(old, shown, tmp_path / "new"))
    assert everything_in(tmp_path) == before


def old_format(data: Path) -> None:
    info = json.loads((data / "meta/info.json").read_text())
    (data / "meta/info.json").write_text(json.dumps({**info, "codebase_version": "v2.1"}))


def half_of_the_frames(data: Path) -> None:
    (file,) = (data / "data").rglob("*.parquet")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


@pytest.mark.parametrize(
    ("damage", "message"), [(old_format, "2.1 format"), (half_of_the_frames, "data cannot be read: ")]
)
def test_a_damaged_dataset_ends_in_one_line_and_nothing_written(
    damage, message, checkpoint, shown, tmp_path, refused
):
    data = damaged(shown, tmp_path / "data", damage)
    before = everything_in(tmp_path)
    assert message in refused(*arguments(checkpoint("diffusion"), data, tmp_path / "new"))
    assert everything_in(tmp_path) == before


@pytest.mark.parametrize("episodes", ["[]", "[5]", "[0,99]", "[-1]"])
def test_episodes_that_the_dataset_does_not_have_are_named(episodes, checkpoint, shown, tmp_path, refused):
    options = arguments(checkpoint("fmp"), shown, tmp_path / "new")
    line = refused(*options, f"--dataset.episodes={episodes}")
    assert f"episodes must be some of 0 to 4, got {json.loads(episodes)}" in line
    assert everything_in(tmp_path) == []


def test_a_mistyped_path_that_looks_like_a_repository_is_named(shown, tmp_path, refused):
    assert "outputs/dpff" in refused(*arguments(Path("outputs/dpff"), shown, tmp_path / "new"))
    assert everything_in(tmp_path) == []


def test_an_existing_output_ends_in_one_line(checkpoint, fitted, shown, tmp_path, refused):
    new = damaged(fitted("fmp"), tmp_path / "new", lambda path: None)
    line = refused(*arguments(checkpoint("fmp"), shown, new))
    assert line == f"error: {new} exists already: choose another --output_dir, or pass --overwrite=true"


def test_ctrl_c_ends_in_one_line_and_nothing_written(
    checkpoint, shown, tmp_path, monkeypatch, command, capfd
):
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(DemonstratedActions, "observe", interrupt)
    with pytest.raises(SystemExit, match="130"):
        command(*arguments(checkpoint("fmp"), shown, tmp_path / "new"))
    captured = capfd.readouterr()
    assert captured.err.splitlines()[-1] == "interrupted: nothing half-written was left behind"
    assert "Traceback" not in captured.err
    assert "Wrote" not in captured.out
    assert everything_in(tmp_path) == []


def test_help_shows_examples_and_units(command, capsys):
    with pytest.raises(SystemExit, match="0"):
        command("--help")
    words = " ".join(capsys.readouterr().out.split())
    assert "Examples: pf2mp-fit-field --policy.path=" in words
    for said in ("Hub", "[normalised action units]", "--policy.field_action_dims", "--dataset.episodes"):
        assert said in words


# From the Hub.

QUESTIONS = """
from huggingface_hub import HfApi, hf_hub_download, snapshot_download

for repo_type in ("model", "dataset"):
    api = HfApi()
    here = {"repo_id": "user/repo", "repo_type": repo_type}
    everything = ["a.json", "sub/b c.bin", "sub/deep/empty"]
    info = api.repo_info(**here)
    assert [info.id, info.sha] == ["user/repo", SHA], info
    assert [sibling.rfilename for sibling in info.siblings] == everything
    old = api.repo_info(**here, revision="v3.0", files_metadata=True)
    assert old.sha == OLD_SHA
    assert [(sibling.rfilename, sibling.size) for sibling in old.siblings] == [("a.json", 3)]
    refs = api.list_repo_refs(**here)
    assert [(ref.name, ref.ref, ref.target_commit) for ref in refs.branches + refs.tags] == [
        ("main", "refs/heads/main", SHA),
        ("v3.0", "refs/tags/v3.0", OLD_SHA),
    ]
    assert api.list_repo_files(**here) == everything
    assert [entry.path for entry in api.list_repo_tree(**here)] == ["a.json", "sub"]
    assert [entry.path for entry in api.list_repo_tree(**here, path_in_repo="sub")] == ["sub/b c.bin", "sub/deep"]
    found = api.get_paths_info(**here, paths=["sub", "a.json", "none"])
    assert [entry.path for entry in found] == ["sub", "a.json"]
    assert api.file_exists(**here, filename="sub/b c.bin")
    assert not api.file_exists(**here, filename="none")
    assert api.revision_exists(**here, revision=OLD_SHA)
    assert not api.revision_exists(**here, revision="none")
    assert not api.repo_exists("user/none", repo_type=repo_type)
    folder = snapshot_download(**here)
    for name, size in zip(everything, (2, 300_000, 0)):
        with open(f"{folder}/{name}", "rb") as file:
            assert len(file.read()) == size
    with open(hf_hub_download(**here, filename="a.json", revision="v3.0")) as file:
        assert file.read() == "old"
    with open(hf_hub_download(**here, filename="a.json")) as file:
        assert file.read() == "{}"
    for missing in ({"filename": "none"}, {"filename": "a.json", "revision": "none"}):
        try:
            hf_hub_download(**here, **missing)
        except OSError as error:
            print(type(error).__name__)
"""


@pytest.mark.slow
def test_the_hub_of_these_tests_answers_the_real_client(tmp_path):
    """The other tests here could else pass for the wrong reason."""
    old, new = tmp_path / "old", tmp_path / "new"
    (new / "sub/deep").mkdir(parents=True)
    old.mkdir()
    (old / "a.json").write_text("old")
    (new / "a.json").write_text("{}")
    (new / "sub/b c.bin").write_bytes(bytes(300_000))
    (new / "sub/deep/empty").touch()
    with HubServer() as hub:
        for repo_type in ("model", "dataset"):
            old_sha = hub.add(repo_type, "user/repo", old, tags=["v3.0"])
            sha = hub.add(repo_type, "user/repo", new)
        finished = subprocess.run(
            [sys.executable, "-c", f"SHA, OLD_SHA = {sha!r}, {old_sha!r}\n{QUESTIONS}"],
            env=hub.environment(tmp_path / "home"),
            capture_output=True,
            text=True,
            timeout=SECONDS,
            check=False,
        )
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.split() == ["RemoteEntryNotFoundError", "RevisionNotFoundError"] * 2


COMMANDS = """
import json, sys, traceback
from lerobot_pf2mp.commands import cli

for name, arguments in json.loads(sys.argv[1]).items():
    sys.argv = ["pf2mp-fit-field", *arguments]
    print(f"=== {name}", file=sys.stderr, flush=True)
    try:
        cli.fit_field()
    except SystemExit:
        pass
    except BaseException:
        traceback.print_exc()
"""


@pytest.fixture(scope="module")
def hub(checkpoint: Make, folder: Path, shown: Path) -> Iterator[HubServer]:
    """A Hub with a checkpoint and a dataset, each with an older revision."""
    with HubServer() as hub:
        hub.add("model", "user/repo", checkpoint("fmp"), tags=["first"])
        hub.add("model", "user/repo", checkpoint("diffusion"))
        hub.add("model", "user/bare", checkpoint("diffusion"))
        del next(iter(hub.repositories["model", "user/bare"].commits.values()))["policy_preprocessor.json"]
        hub.add("dataset", "user/data", folder / "learned", branch="first")
        hub.add("dataset", "user/data", with_videos(shown, folder / "with_videos"), tags=["v3.0"])
        hub.add("dataset", "user/untagged", shown)
        hub.broken.add("user/broken")
        yield hub


def with_videos(data: Path, copy: Path) -> Path:
    """The dataset with a video file, which is none and must not be asked for."""
    shutil.copytree(data, copy)
    (copy / "videos/observation.images.front/chunk-000").mkdir(parents=True)
    (copy / "videos/observation.images.front/chunk-000/file-000.mp4").write_text("no video")
    return copy


@pytest.mark.slow
def test_checkpoint_and_dataset_may_come_from_the_hub(hub, fitted, tmp_path):
    finished = subprocess.run(
        [
            BIN / "pf2mp-fit-field",
            "--policy.path=user/repo",
            "--dataset.repo_id=user/data",
            "--output_dir=new",
        ],
        cwd=tmp_path,
        env=hub.environment(tmp_path / "home"),
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr[-6000:]
    assert finished.stdout.splitlines()[-1] == "Wrote a dppf checkpoint to new."
    assert "Traceback" not in finished.stderr
    new, expected = contents_of(tmp_path / "new"), contents_of(fitted("diffusion"))
    assert new.keys() == expected.keys()
    assert [file for file in new if new[file] != expected[file]] == ["config.json"]
    assert config_of(tmp_path / "new") == {**config_of(fitted("diffusion")), "pretrained_path": "user/repo"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["home", "new"]
    assert not [request for request in hub.requests if "/videos/" in request.path]
    assert [request for request in hub.requests if "/data/chunk-000" in request.path]


@pytest.fixture(scope="module")
def said(hub: HubServer, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the command says with each of several arguments, run one after the other in one process."""
    folder = tmp_path_factory.mktemp("said")
    policy, data = "--policy.path=user/repo", "--dataset.repo_id=user/data"
    cases = {
        "revisions": [policy, "--policy.revision=first", data, "--dataset.revision=first"],
        "missing_checkpoint": ["--policy.path=user/none", data],
        "missing_revision": [policy, "--policy.revision=none", data],
        "missing_preprocessor": ["--policy.path=user/bare", data],
        "missing_dataset": [policy, "--dataset.repo_id=user/none"],
        "missing_dataset_revision": [policy, data, "--dataset.revision=none"],
        "untagged_dataset": [policy, "--dataset.repo_id=user/untagged"],
        "missing_episode": [policy, data, "--dataset.root=downloaded", "--dataset.episodes=[0,99]"],
        "broken_checkpoint": ["--policy.path=user/broken", data],
        "broken_dataset": [policy, "--dataset.repo_id=user/broken"],
    }
    cases = {name: [*options, f"--output_dir={name}"] for name, options in cases.items()}
    finished = subprocess.run(
        [sys.executable, "-c", COMMANDS, json.dumps(cases)],
        cwd=folder,
        env=hub.environment(folder / "home"),
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    parts = [part.partition("\n") for part in finished.stderr.split("=== ")[1:]]
    assert [name for name, _, _ in parts] == list(cases), finished.stderr[-6000:]
    return {"folder": str(folder), **{name: text for name, _, text in parts}}


@pytest.mark.slow
def test_a_revision_of_the_checkpoint_and_one_of_the_dataset_can_be_chosen(
    said, checkpoint, folder, tmp_path
):
    new = contents_of(Path(said["folder"]) / "revisions")
    expected = contents_of(fit(checkpoint("fmp"), tmp_path / "expected", folder / "learned"))
    assert new.keys() == expected.keys()
    assert [file for file in new if new[file] != expected[file]] == ["config.json"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("missing_checkpoint", "user/none cannot be loaded: "),
        ("missing_revision", "user/repo at revision .* cannot be loaded: "),
        ("missing_dataset", "Not Found.*user/none"),
        ("missing_dataset_revision", "Revision Not Found.*user/data/revision/none"),
        ("untagged_dataset", "must be tagged.*user/untagged"),
        ("missing_preprocessor", "user/bare cannot be loaded: .*policy_preprocessor.json"),
        ("missing_episode", r"user/data in downloaded cannot be read: .* 0 to 4, got \[0, 99\]"),
        ("broken_checkpoint", "user/broken cannot be loaded: "),
        ("broken_dataset", "user/broken cannot be read: "),
    ],
)
def test_what_is_missing_on_the_hub_is_named_in_one_line(said, case, message):
    assert re.search(f"error: .*{message}", error_of(said[case])), said[case]
    assert sorted(path.name for path in Path(said["folder"]).iterdir()) == ["home", "revisions"]
