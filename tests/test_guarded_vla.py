# SPDX-License-Identifier: Apache-2.0
"""Vision-language-action policies and multi_task_dit, guarded. They need transformers, see ``make test``."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
import torch

pytest.importorskip("transformers")

from hub_server import HubServer
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from safetensors.torch import save_file
from tiny_vla import ACTION, CHUNK, IMAGE, SIZE, STATE, A, tiny_config, tiny_observation, tiny_weights
from torch import Tensor

from lerobot_pf2mp import GuardedConfig, load_policy
from lerobot_pf2mp.policies.guarded.generation import generation_of
from lerobot_pf2mp.policies.guarded.modeling_guarded import GuardedPolicy
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.policies.guided.potential_field_step import PotentialFieldProcessorStep

KINDS = ("pi0", "pi05", "smolvla", "multi_task_dit, flow_matching", "multi_task_dit, diffusion")
VLA = KINDS[:3]
every_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(autouse=True, scope="module")
def few_weights() -> Iterator[None]:
    with tiny_weights():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("vla") / "smolvlm"


def guarded(kind: str, folder: Path, **options: Any) -> Any:
    torch.manual_seed(1)
    return GuardedPolicy(GuardedConfig(base=tiny_config(kind, folder), **options)).eval()


def stock(policy: Any) -> Any:
    config = policy.config.base_config
    plain = get_policy_class(config.type)(config).eval()
    plain.load_state_dict(policy.base.state_dict())
    return plain


def show(shown: DemonstratedActions, policy: Any) -> DemonstratedActions:
    """Twenty demonstrations near 0.5."""
    generator = torch.Generator().manual_seed(0)
    shown.observe(
        0.5 + 0.05 * torch.randn(20, CHUNK, A, generator=generator),
        None,
        CHUNK * torch.arange(20),
        torch.arange(20),
        settings=policy.config.field_settings,
        n_executed=CHUNK,
    )
    return shown


def field_batch(policy: Any, n_robots: int = 2) -> dict[str, Any]:
    shown = show(DemonstratedActions(policy.config.field_settings), policy)
    return {**tiny_observation(n_robots), "potential_field": shown}


def selected(policy: Any, batch: dict[str, Any], n_steps: int = CHUNK) -> Tensor:
    torch.manual_seed(5)
    policy.reset()
    return torch.stack([policy.select_action(dict(batch)) for _ in range(n_steps)], dim=1)


@every_kind
def test_without_guidance_and_check_actions_are_bit_for_bit_the_bases(kind, folder):
    policy = guarded(kind, folder, guidance_scale=0, max_plans=1)
    assert torch.equal(selected(policy, tiny_observation()), selected(stock(policy), tiny_observation()))


@every_kind
def test_guidance_raises_the_support_of_the_plan_with_as_many_calls_of_the_network(kind, folder):
    policy = guarded(kind, folder, max_plans=1)
    calls: list[int] = []
    network = policy.base.model if kind in VLA else policy.base.noise_predictor
    inner = network.action_out_proj if kind in VLA else network.output_proj
    inner.register_forward_hook(lambda *_: calls.append(1))
    batch = field_batch(policy)
    field = batch["potential_field"].field(policy.config.field_settings)
    chunk = selected(policy, batch)
    n_guided = len(calls)
    policy.config.guidance_scale = 0
    unguided = selected(policy, batch)
    assert len(calls) == 2 * n_guided
    assert (field.log_density(chunk) >= field.log_density(unguided) - 1e-3).all()
    assert field.log_density(chunk).mean() > field.log_density(unguided).mean() + 1


@every_kind
def test_each_is_guided_inside_its_steps(kind, folder):
    where = generation_of(guarded(kind, folder).base).where
    assert where == "in every " + ("denoising step" if "diffusion" in kind else "integration step")


@every_kind
def test_a_plan_that_leaves_the_demonstrations_is_drawn_again_for_that_robot(kind, folder):
    policy = guarded(kind, folder, guidance_scale=0, max_plans=3)
    batch = field_batch(policy)
    selected(policy, batch, n_steps=1)
    assert policy.plans.n_drawn.tolist() == [3, 3]
    assert policy.plans.is_flagged.all()
    assert not policy._draws_alike


@every_kind
def test_nothing_of_the_base_is_replaced_for_good(kind, folder):
    policy = guarded(kind, folder)
    selected(policy, field_batch(policy), n_steps=1)
    replaced = {"denoise_step", "forward", "predict_action_chunk", "_get_action_chunk"}
    for module in policy.base.modules():
        assert not replaced & set(vars(module))


def test_smolvla_that_generates_in_other_units_is_guided_at_the_end(folder):
    policy = guarded("smolvla", folder)
    policy.base.config.adapt_to_pi_aloha = True
    assert generation_of(policy.base).where == "on the finished chunk"


def test_runge_kutta_steps_are_guided_at_the_end(folder):
    policy = guarded("multi_task_dit, flow_matching", folder)
    policy.base.config.integration_method = "rk4"
    assert generation_of(policy.base).where == "on the finished chunk"


@pytest.mark.parametrize("kind", VLA)
def test_real_time_chunking_continues_the_last_chunk_and_is_guided(kind, folder):
    policy = guarded(kind, folder, max_plans=1)
    assert policy.supports_rtc()
    # As LeRobot has it. With fewer steps the correction, whose weight is up to 10, overshoots with or without a guide.
    setattr(policy.config, "num_steps" if kind == "smolvla" else "num_inference_steps", 10)
    policy.config.rtc_config = RTCConfig(enabled=True, execution_horizon=4)
    policy.init_rtc_processor()
    batch = field_batch(policy)
    field = batch["potential_field"].field(policy.config.field_settings)
    torch.manual_seed(5)
    first = policy.predict_action_chunk(batch)
    left_over = first[:, 2:]
    options = {"prev_chunk_left_over": left_over, "inference_delay": 2, "execution_horizon": 4}
    torch.manual_seed(6)
    second = policy.predict_action_chunk(dict(batch), **options)
    torch.manual_seed(6)
    free = policy.predict_action_chunk(dict(batch))
    assert second.isfinite().all()
    assert (second[:, :2] - left_over[:, :2]).norm() < (free[:, :2] - left_over[:, :2]).norm()
    policy.config.guidance_scale = 0
    torch.manual_seed(6)
    unguided = policy.predict_action_chunk(dict(batch), **options)
    assert field.log_density(second).mean() > field.log_density(unguided).mean()


@pytest.mark.parametrize("time", [1.0, 0.7, 0.1])
def test_real_time_chunking_does_not_undo_the_guide(time, folder):
    """The guided velocity is the corrected one of the unguided policy and the offset of the guide."""
    policy = guarded("pi05", folder, max_plans=1)
    policy.config.rtc_config = RTCConfig(enabled=True, execution_horizon=6)
    policy.init_rtc_processor()
    guide = policy.guidance.guide(field_batch(policy), torch.device("cpu"))
    generation = generation_of(policy.base)
    processor = policy.base.model.rtc_processor
    x_t, left_over, weight = torch.randn(1, CHUNK, A), torch.full((1, CHUNK, A), 0.5), torch.randn(A, A)

    def step() -> Tensor:
        return processor.denoise_step(
            x_t=x_t,
            prev_chunk_left_over=left_over,
            inference_delay=2,
            time=time,
            original_denoise_step_partial=lambda x: x @ weight,
            execution_horizon=6,
        )

    unguided = step()
    with generation.guided(guide):
        bent = step()
    assert torch.equal(step(), unguided)
    dt = 1 / policy.config.num_inference_steps
    x_next, x_1 = x_t - dt * unguided, x_t - time * (x_t @ weight)
    torch.testing.assert_close(x_t - dt * bent, guide(x_t, x_next, x_1, dt), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", VLA)
def test_weights_that_are_not_there_are_an_error(kind, folder, tmp_path):
    """pi0's own loading goes on with random weights."""
    policy = guarded(kind, folder)
    policy.save_pretrained(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises((ValueError, OSError), match=r"model\.safetensors|No such file"):
        GuardedPolicy.from_pretrained(tmp_path)


def test_weights_of_another_network_are_an_error(folder, tmp_path):
    guarded("pi0", folder).save_pretrained(tmp_path)
    save_file({"something.else": torch.randn(3)}, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match="none of the weights in .* are those of the pi0 policy"):
        GuardedPolicy.from_pretrained(tmp_path)


@every_kind
def test_a_checkpoint_comes_back_with_identical_actions(kind, folder, tmp_path):
    policy = guarded(kind, folder)
    stats = {key: {"mean": torch.zeros(A), "std": torch.ones(A)} for key in (STATE, ACTION)}
    stats |= {key: {"min": -torch.ones(A), "max": torch.ones(A), **stats[key]} for key in (STATE, ACTION)}
    stats |= {key: {"q01": -torch.ones(A), "q99": torch.ones(A), **stats[key]} for key in (STATE, ACTION)}
    preprocessor, postprocessor = make_pre_post_processors(policy.config, dataset_stats=stats)
    step = next(s for s in preprocessor.steps if isinstance(s, PotentialFieldProcessorStep))
    show(step.demonstrations, policy)
    for part in (policy, preprocessor, postprocessor):
        part.save_pretrained(tmp_path)
    again, preprocess, _ = load_policy(tmp_path, device="cpu")
    for name, value in policy.base.state_dict().items():
        assert torch.equal(value, cast(Any, again).base.state_dict()[name])
    seen = {STATE: torch.zeros(A), IMAGE: torch.zeros(3, SIZE, SIZE), "task": "reach the goal"}
    batch, other = preprocess(dict(seen)), preprocessor(dict(seen))
    assert torch.equal(selected(policy, other), selected(again, batch))
    # The base's own class loads the same file.
    plain = PreTrainedConfig.from_pretrained(tmp_path).base_config
    base = get_policy_class(plain.type).from_pretrained(tmp_path, config=plain)
    for name, value in policy.base.state_dict().items():
        assert torch.equal(value, base.state_dict()[name])


@pytest.mark.slow
def test_smolvla_is_trained_guarded_published_and_evaluated_by_the_commands(folder, tmp_path):
    """Its vision-language model, the guarded checkpoint and everything else come from the Hub."""
    tiny_config("smolvla", folder)  # writes the vision-language model
    data, guarded_folder, trained = tmp_path / "data", tmp_path / "guarded", tmp_path / "trained"
    with HubServer() as hub:
        hub.add("model", "user/tiny-vlm", folder)
        hub.users["a token"] = "user"
        env = hub.environment(tmp_path, token="a token")

        def run(command: str, *arguments: str) -> str:
            call = [str(Path(sys.executable).parent / command), *arguments]
            finished = subprocess.run(call, env=env, capture_output=True, text=True, check=False, timeout=600)
            assert finished.returncode == 0, finished.stdout[-2000:] + finished.stderr[-4000:]
            return finished.stdout + finished.stderr

        run(
            "pf2mp-collect",
            "--task=maze_umaze",
            "--n_episodes=4",
            "--obs_type=pixels_agent_pos",
            f"--root={data}",
        )
        dataset = ("--dataset.repo_id=local/maze", f"--dataset.root={data}")
        policy = {
            "type": "smolvla",
            "device": "cpu",
            "push_to_hub": "false",
            "vlm_model_name": "user/tiny-vlm",
            "num_vlm_layers": "2",
            "num_steps": "2",
            "resize_imgs_with_padding": f"[{SIZE},{SIZE}]",
            "chunk_size": "8",
            "n_action_steps": "8",
        }
        run(
            "lerobot-train",
            *(f"--policy.{name}={value}" for name, value in policy.items()),
            *dataset,
            "--steps=2",
            "--batch_size=2",
            "--num_workers=0",
            f"--output_dir={trained}",
        )
        base = trained / "checkpoints/last/pretrained_model"
        said = run("pf2mp-fit-field", f"--policy.path={base}", *dataset, f"--output_dir={guarded_folder}")
        assert "Wrote a guarded checkpoint" in said
        run("pf2mp-push", f"--path={guarded_folder}", "--repo_id=user/guarded")
        card = hub.repositories["model", "user/guarded"].files()["README.md"].decode()
        assert "A smolvla policy, guarded by a potential field" in card
        said = run(
            "lerobot-eval",
            "--policy.path=user/guarded",
            "--env.type=pf2mp_maze",
            "--env.task=MazeUMaze-v0",
            "--env.obs_type=pixels_agent_pos",
            "--eval.n_episodes=1",
            "--eval.batch_size=1",
            f"--output_dir={tmp_path / 'eval'}",
        )
        assert "pc_success" in said
        assert "Plans are not checked" not in said
        assert any("tiny-vlm" in request.path for request in hub.requests)
