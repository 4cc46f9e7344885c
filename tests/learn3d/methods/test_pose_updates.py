"""A training finds poses again from its own shapes."""

from __future__ import annotations

import contextlib
import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from darts import dart_shapes, darts

from learn3d.data.poses import LookAtPoses, PoseCandidates
from learn3d.methods.method import Meshes
from learn3d.methods.pose_updates import update_poses, update_steps


def test_poses_are_found_again_from_the_models_shapes() -> None:
    (vertices, faces), dataset = dart_shapes(6), darts(6)
    poses = LookAtPoses(torch.arange(24.0).repeat(144) * 15, 30.0, 2.732, 15.0)
    weights = np.full((144, 24), 1 / 24, np.float32)
    candidates = PoseCandidates(poses, np.zeros(24 * 144, int), weights, weights)
    dataset = dataclasses.replace(dataset, candidates=candidates)
    batches_of_shapes = iter(vertices.repeat_interleave(24, 0).split(128))
    decode = lambda codes: Meshes(next(batches_of_shapes), faces)  # noqa: E731
    method = SimpleNamespace(
        in_use=contextlib.nullcontext, encode=torch.Tensor.float, decode=decode
    )
    changed = update_poses(method, dataset)
    found = torch.from_numpy(candidates.weights.argmax(1)) * 15.0
    assert ((found - dataset.poses.azimuth_deg + 180) % 360 - 180).abs().max() == 0
    assert np.allclose(candidates.weights.sum(1), 1) and changed == pytest.approx(1 - 1 / 24)
    assert (
        update_steps(1600, 3) == (200, 400, 800)
        and update_steps(2, 3) == (1,)
        and update_steps(9, 0) == ()
    )


def test_the_table_counts_and_azimuths_keep_their_frequency() -> None:
    """Ten equal images with one shape, so only the table tells them apart."""
    (vertices, faces), dataset = dart_shapes(1), darts(1).select(np.full(10, 2))
    poses = LookAtPoses(torch.tensor([-30.0, 150.0]).repeat(10), 30.0, 2.732, 15.0)
    prior = np.float32([[0.9, 0.1]] * 5 + [[0.3, 0.7]] * 5)
    candidates = PoseCandidates(poses, np.zeros(20, int), prior, prior)
    dataset = dataclasses.replace(dataset, candidates=candidates)
    method = SimpleNamespace(
        in_use=contextlib.nullcontext,
        encode=torch.Tensor.float,
        decode=lambda codes: Meshes(vertices.expand(len(codes), -1, -1), faces),
    )
    assert update_poses(method, dataset) == 0
    np.testing.assert_allclose(candidates.weights, prior, atol=1e-3)
