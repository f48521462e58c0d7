# SPDX-License-Identifier: Apache-2.0
"""Nearest points."""

import torch

from lerobot_pf2mp.nearest import NearestPoints


def test_the_nearest_points_are_those_of_all_distances() -> None:
    points, queries = torch.randn(300, 3), torch.randn(50, 3)
    squares, nearest = NearestPoints(points)(queries)
    wanted = torch.cdist(queries.double(), points.double()).square().min(dim=1)
    assert torch.equal(nearest, wanted.indices)
    torch.testing.assert_close(squares, wanted.values)


def test_queries_far_away_or_not_a_number_end_somewhere() -> None:
    queries = torch.tensor([[1e30, 0.0], [float("nan"), 0.0]])
    _, nearest = NearestPoints(torch.eye(2))(queries)
    assert nearest[0] == 0
    assert 0 <= nearest[1] <= 1
