# SPDX-License-Identifier: Apache-2.0
"""The tasks of the environments: their names, and the default number of steps of an episode.

Plain tables, for modules that must not import LeRobot or MuJoCo.
"""

# Keys: the names for Gymnasium and --env.task. Values: the maze, the Fetch task, the space of the actions.
MAZE_TASKS = {"MazeUMaze-v0": "umaze", "MazeMedium-v0": "medium", "MazeLarge-v0": "large"}
FETCH_TASKS = {"FetchReachWall-v0": "reach", "FetchPushWall-v0": "push"}
HANDWRITING_TASKS = {"HandwritingJoint-v0": "joint", "HandwritingPen-v0": "pen"}
# Keys: Meta-World's own names, also for Gymnasium and --env.task. Values: the task in words.
METAWORLD_TASKS = {
    "reach-wall-v3": "Move the gripper over the wall to the goal without touching the wall.",
    "push-wall-v3": "Push the puck around the wall to the goal without touching the wall.",
    "pick-place-wall-v3": "Carry the puck over the wall to the goal without touching the wall.",
}

# Keys: the names for Gymnasium. The second one is what so101-nexus' robot drives, for as long as it likes.
SO101_STEPS = 96
SO101_CLASSES: dict[str, tuple[str, int | None]] = {
    "SO101Fence-v0": ("fence_env:SO101FenceEnv", SO101_STEPS),
    "SO101FenceSimulation-v0": ("fence_simulation:FenceSimulation", None),
}

# Keys: the names for pf2mp-collect and pf2mp-convert. Values: the same as above.
MAZE_OF_TASK = {"maze_umaze": "umaze", "maze_medium": "medium", "maze_large": "large"}
FETCH_OF_TASK = {"fetch_reach": "reach", "fetch_push": "push"}
SO101_TASK = "so101_fence"
SPACE_OF_TASK = {"handwriting_joint": "joint", "handwriting_pen": "pen"}
METAWORLD_OF_TASK = {
    "metaworld_reach_wall": "reach-wall-v3",
    "metaworld_push_wall": "push-wall-v3",
    "metaworld_pick_place_wall": "pick-place-wall-v3",
}

MAZE_STEPS = 80
FETCH_STEPS = 48
HANDWRITING_STEPS = 64
METAWORLD_STEPS = 112
METAWORLD_MOST_STEPS = 500  # Meta-World's own limit
METAWORLD_FPS = 80
METAWORLD_MISSING = 'the Meta-World tasks need: pip install "lerobot_policy_pf2mp[metaworld]"'

# The state of robot and environment, or the state of the robot and camera images.
OBS_TYPES = ("state", "pixels_agent_pos")

# What moves the arms that write.
SIMULATORS = ("mujoco", "genesis")

# The arms that write; each has a module of this name in `envs.handwriting`.
ROBOTS = ("panda", "unitree_z1")
