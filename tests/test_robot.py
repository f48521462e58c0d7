# SPDX-License-Identifier: Apache-2.0
"""Policies on a robot, through LeRobot's own commands."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from forked_commands import SECONDS, ForkedCommand, run_well
from lerobot.datasets import LeRobotDataset

from lerobot_pf2mp.commands import cli
from lerobot_pf2mp.dataset_tools.handwriting.collect_handwriting import collect_handwriting

pytestmark = pytest.mark.slow

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}  # where simulated_panda is


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A hardly trained policy, and the postures (N, 9) that were demonstrated."""
    folder = tmp_path_factory.mktemp("robot")
    collect_handwriting(
        "joint",
        root=folder / "data",
        repo_id="local/data",
        n_episodes=3,
        n_steps=64,
        scene_options={},
        seed=0,
        overwrite=False,
    )
    run_well(
        "lerobot-train",
        "--policy.type=pf2mp",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--policy.horizon=16",
        "--policy.n_action_steps=8",
        "--policy.down_dims=[8,16]",
        "--policy.guidance_scale=0.5",
        "--policy.field_action_dims=[0,1,2,3,4,5,6]",
        "--dataset.repo_id=local/data",
        f"--dataset.root={folder / 'data'}",
        f"--output_dir={folder / 'out'}",
        "--batch_size=32",
        "--num_workers=0",
        "--steps=12",
    )
    actions = LeRobotDataset("local/data", root=folder / "data").hf_dataset.with_format("numpy")["action"][:]
    return folder / "out/checkpoints/last/pretrained_model", np.asarray(actions)


def distance_from_demonstrations(log: Path, demonstrated: np.ndarray) -> float:
    """Mean distance of the arm's targets in a log to the nearest demonstrated posture [rad]."""
    targets = np.array([json.loads(line) for line in log.read_text().splitlines()])[:, :7]
    assert len(targets) >= 8 and np.isfinite(targets).all()
    gaps = np.linalg.norm(targets[:, None] - demonstrated[None, :, :7], axis=-1)
    return float(gaps.min(axis=1).mean())


def roll_out(checkpoint: Path, log: Path, *options: str, n_actions: int) -> None:
    """Lets the robot act, at 10 Hz, and interrupts it after so many actions."""
    rollout = ForkedCommand(
        "lerobot-rollout",
        f"--policy.path={checkpoint}",
        "--device=cpu",
        "--robot.type=simulated_panda",
        "--robot.discover_packages_path=simulated_panda",
        f"--robot.log={log}",
        "--fps=10",
        f"--duration={SECONDS}",
        "--play_sounds=false",
        "--return_to_initial_position=false",
        *options,
    )
    try:
        end = time.monotonic() + SECONDS
        while not log.exists() or log.read_text().count("\n") < n_actions:
            assert rollout.poll() is None, rollout.read()
            assert time.monotonic() < end
            time.sleep(0.1)
        rollout.send_signal(signal.SIGINT)
        said = rollout.communicate(SECONDS)
    finally:
        rollout.kill()
    assert rollout.returncode == 0, said


def test_a_rollout_moves_the_arm_and_guidance_keeps_it_near_the_demonstrations(
    demonstrated: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    checkpoint, postures = demonstrated
    distances = {}
    for scale in (0.5, 0.0):
        log = tmp_path / f"{scale}.jsonl"
        roll_out(checkpoint, log, f"--policy.guidance_scale={scale}", n_actions=32)
        distances[scale] = distance_from_demonstrations(log, postures)
    assert distances[0.5] < 0.2 * distances[0.0]


def test_a_rollout_with_real_time_chunking_moves_the_arm_near_the_demonstrations(
    demonstrated: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    checkpoint, postures = demonstrated
    log = tmp_path / "chunks.jsonl"
    roll_out(checkpoint, log, "--inference.type=rtc", "--inference.rtc.execution_horizon=6", n_actions=40)
    # Between two chunks, and on a busy machine, the arm is further from the demonstrations than at their postures.
    assert distance_from_demonstrations(log, postures) < 0.2


@pytest.mark.parametrize("inference", ["sync", "rtc"])
def test_a_rollout_is_stopped_before_a_plan_that_nobody_demonstrated(
    inference: str, demonstrated: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    checkpoint, _ = demonstrated
    rollout = ForkedCommand(
        "lerobot-rollout",
        f"--policy.path={checkpoint}",
        "--policy.guidance_scale=0",
        "--policy.on_unsupported=stop",
        "--device=cpu",
        "--robot.type=simulated_panda",
        "--robot.discover_packages_path=simulated_panda",
        f"--robot.log={tmp_path / 'log.jsonl'}",
        "--fps=10",
        "--duration=60",
        "--play_sounds=false",
        "--return_to_initial_position=false",
        f"--inference.type={inference}",
    )
    try:
        said = "".join(rollout.communicate(SECONDS))
    finally:
        rollout.kill()
    assert "leaves the demonstrated region" in said and "on_unsupported=stop" in said
    assert "Disconnecting robot" in said, said
    # Nothing of the plan was executed: the robot rests where it was.
    log = tmp_path / "log.jsonl"
    assert not log.exists() or not log.read_text()
    # With real-time chunking LeRobot ends the rollout as finished when its thread gives up.
    assert inference == "rtc" or rollout.returncode != 0, said


@pytest.mark.parametrize("inference", ["sync", "rtc"])
def test_a_compiled_policy_moves_the_arm_near_the_demonstrations(
    inference: str, demonstrated: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    checkpoint, postures = demonstrated
    log = tmp_path / "compiled.jsonl"
    # What can go wrong is the capturing, not inductor, which takes a minute more.
    options = [f"--inference.type={inference}", "--use_torch_compile=true", "--torch_compile_backend=eager"]
    roll_out(checkpoint, log, *options, n_actions=40)
    assert distance_from_demonstrations(log, postures) < 0.2


@contextmanager
def policy_server(folder: Path) -> Iterator[str]:
    """The address of a pf2mp-policy-server that runs in a folder, where LeRobot writes its log."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = ForkedCommand("pf2mp-policy-server", f"--port={port}", "--fps=10", cwd=folder)
    try:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and server.poll() is None:
            with socket.socket() as client:
                if client.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.2)
        assert server.poll() is None, server.read()
        yield f"127.0.0.1:{port}"
    finally:
        server.terminate()
        server.communicate(timeout=30)


CLIENT = """
import sys, threading, time
from pathlib import Path
import simulated_panda
from lerobot.async_inference.configs import RobotClientConfig
from lerobot.async_inference.robot_client import RobotClient

address, checkpoint, log = sys.argv[1], sys.argv[2], Path(sys.argv[3])
client = RobotClient(RobotClientConfig(
    policy_type="pf2mp", pretrained_name_or_path=checkpoint, actions_per_chunk=8, server_address=address, fps=10,
    robot=simulated_panda.SimulatedPandaConfig(log=str(log))))
assert client.start()
receiver = threading.Thread(target=client.receive_actions, daemon=True)
receiver.start()
def stop_after_five_chunks():
    while not (log.exists() and log.read_text().count("\\n") >= 40):
        time.sleep(0.1)
    client.shutdown_event.set()

threading.Thread(target=stop_after_five_chunks, daemon=True).start()
client.control_loop(task="")
client.stop()
"""


def test_the_server_answers_lerobots_own_client(
    demonstrated: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    checkpoint, postures = demonstrated
    log = tmp_path / "served.jsonl"
    with policy_server(tmp_path) as address:
        finished = subprocess.run(
            [sys.executable, "-c", CLIENT, address, str(checkpoint), str(log)],
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
            env=ENVIRONMENT,
            cwd=tmp_path,
        )
    assert finished.returncode == 0, finished.stderr[-4000:]
    assert distance_from_demonstrations(log, postures) < 0.05


def test_the_server_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "grpc", None)
    for name in list(sys.modules):
        if name.startswith(("lerobot.async_inference", "lerobot_pf2mp.serving")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "argv", ["pf2mp-policy-server"])
    with pytest.raises(SystemExit, match="1"):
        cli.policy_server()
    assert re.search(
        r'^error: pf2mp-policy-server needs: pip install "lerobot_policy_pf2mp\[async\]"',
        capsys.readouterr().err,
    )


@pytest.mark.skipif(find_spec("so101_nexus") is None, reason="needs the extra so101")
def test_a_guarded_act_moves_a_simulated_so101_with_lerobots_own_commands(tmp_path: Path) -> None:
    from so101_nexus.lerobot_adapter.synthetic_calibration import write_synthetic_calibration

    from lerobot_pf2mp.dataset_tools.so101.collect_so101 import collect_so101

    root = tmp_path / "data"
    options = {"style": "clear", "seed": 0, "overwrite": False, "image_width": 64}
    collect_so101(root=root, repo_id="local/data", n_episodes=2, n_steps=96, **options)
    dataset = ("--dataset.repo_id=local/data", f"--dataset.root={root}")
    sizes = ("--policy.dim_model=16", "--policy.dim_feedforward=16", "--policy.n_heads=2")
    run_well(
        "lerobot-train",
        "--policy.type=act",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--policy.pretrained_backbone_weights=null",
        "--policy.chunk_size=8",
        "--policy.n_action_steps=8",
        *sizes,
        *dataset,
        f"--output_dir={tmp_path / 'act'}",
        "--batch_size=2",
        "--num_workers=0",
        "--steps=2",
    )
    run_well(
        "pf2mp-fit-field",
        f"--policy.path={tmp_path / 'act/checkpoints/last/pretrained_model'}",
        "--policy.field_action_dims=[0,1,2,3,4]",
        *dataset,
        f"--output_dir={tmp_path / 'guarded'}",
    )
    write_synthetic_calibration(tmp_path / "calibration", "sim")
    recorded = {}
    for scale in (0.8, 0.0):
        folder = tmp_path / f"rollout_{scale}"
        run_well(
            "lerobot-rollout",
            f"--policy.path={tmp_path / 'guarded'}",
            f"--policy.guidance_scale={scale}",
            "--device=cpu",
            "--strategy.type=sentry",
            "--dataset.repo_id=local/rollout_seen",
            f"--dataset.root={folder}",
            "--dataset.single_task=Carry the cube.",
            "--dataset.push_to_hub=false",
            "--dataset.no_stamp=true",
            "--dataset.fps=20",
            "--robot.type=sim_so_follower",
            "--robot.discover_packages_path=so101_nexus.lerobot_adapter",
            "--robot.id=sim",
            f"--robot.calibration_dir={tmp_path / 'calibration'}",
            "--robot.env_id=lerobot_pf2mp/SO101FenceSimulation-v0",
            "--robot.env_kwargs={image_size: 64}",
            "--robot.seed=0",
            "--robot.cameras={front: {type: sim, source: front, width: 64, height: 64, fps: 20}}",
            "--fps=20",
            "--duration=4",
            "--play_sounds=false",
            "--return_to_initial_position=false",
        )
        recorded[scale] = np.asarray(
            LeRobotDataset("local/rollout_seen", root=folder).hf_dataset.with_format("numpy")["action"][:]
        )
    demonstrated = np.asarray(
        LeRobotDataset("local/data", root=root).hf_dataset.with_format("numpy")["action"][:]
    )
    distances = {
        scale: np.linalg.norm(actions[:, None, :5] - demonstrated[None, :, :5], axis=-1).min(axis=1).mean()
        for scale, actions in recorded.items()
    }
    assert len(recorded[0.8]) >= 8
    assert distances[0.8] < 0.5 * distances[0.0]  # [degrees]
