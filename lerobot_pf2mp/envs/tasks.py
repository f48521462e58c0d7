# SPDX-License-Identifier: Apache-2.0
"""The tasks of the environments: their names, and the default number of steps of an episode.

Plain tables, for modules that must not import LeRobot or MuJoCo.
"""

# By the name for Gymnasium and --env.task: the maze, the Fetch task, the space of the actions.
MAZE_TASKS = {"MazeUMaze-v0": "umaze", "MazeMedium-v0": "medium", "MazeLarge-v0": "large"}
FETCH_TASKS = {"FetchReachWall-v0": "reach", "FetchPushWall-v0": "push"}
HANDWRITING_TASKS = {"HandwritingJoint-v0": "joint", "HandwritingPen-v0": "pen"}

# By the name for pf2mp-collect and pf2mp-convert: the same.
MAZE_OF_TASK = {"maze_umaze": "umaze", "maze_medium": "medium", "maze_large": "large"}
FETCH_OF_TASK = {"fetch_reach": "reach", "fetch_push": "push"}
SPACE_OF_TASK = {"handwriting_joint": "joint", "handwriting_pen": "pen"}

MAZE_STEPS = 80
FETCH_STEPS = 48
HANDWRITING_STEPS = 64

# state, or camera images instead of the environment's state.
OBS_TYPES = ("state", "pixels_agent_pos")
