"""The predictor's layout, its scaling, and its errors."""

from __future__ import annotations

import pytest
import torch

from pace.config.base import ConfigError
from pace.config.training import load_train_config
from pace.predictor.network import PredictorNetwork
from tests.helpers.predictor import predictor_config, serves


def test_sizes_and_slices_follow_the_configuration() -> None:
    full = PredictorNetwork(predictor_config(outputs=["apex", "target", "target_time"]))
    assert (full.input_size, full.output_size) == (15, 7)
    assert full.slices == {"apex": slice(0, 3), "target": slice(3, 6), "target_time": slice(6, 7)}
    apex = PredictorNetwork(predictor_config(outputs=["apex"], frames=3))
    assert (apex.input_size, apex.output_size) == (9, 3)
    assert apex(torch.zeros(4, 9)).shape == (4, 3)


def test_features_are_the_newest_position_and_the_steps_between_frames() -> None:
    network = PredictorNetwork(predictor_config())
    frames = torch.tensor([[0.2, 0, 1], [0.1, 0, 1], [0.0, 0, 1], [-0.1, 0, 1], [-0.2, 0.4, 1.25]])
    features = network.features(frames.flatten()[None])[0]
    torch.testing.assert_close(features[:3], torch.tensor([-0.2, 1.0, 1.0]))
    torch.testing.assert_close(features[3:6], torch.tensor([0.5, 0.0, 0.0]))  # (-0.10 + 0.11) / 0.02
    torch.testing.assert_close(features[12:], torch.tensor([0.5, 20.0, 0.25 / 0.03]))


def test_counted_features_are_five_positions_and_the_number_of_the_frame() -> None:
    five = PredictorNetwork(predictor_config())
    counted = PredictorNetwork(load_train_config(["predictor=counted"]).predictor)
    flight = torch.cumsum(torch.rand(3, 30, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    padding = flight[:, :1].expand(3, 15, 3)
    early = torch.cat([flight[:, :1].expand(3, 42, 3), flight[:, :3]], dim=1)
    features = counted.features(torch.cat([padding, flight], dim=1).flatten(1))
    torch.testing.assert_close(features[:, :15], five.features(flight[:, -5:].flatten(1)))
    assert features.shape == (3, 16)
    torch.testing.assert_close(features[:, 15], torch.full((3,), (29 - 20.0) / 10.0))
    torch.testing.assert_close(counted.features(early.flatten(1))[:, 15], torch.full((3,), (2 - 20.0) / 10.0))
    assert counted(early.flatten(1)).shape == (3, 7)
    with pytest.raises(ConfigError, match="counted needs more than 5 frames, got 5"):
        load_train_config(["predictor.features=counted"])


def test_features_of_real_serves_are_of_order_one() -> None:
    network = PredictorNetwork(predictor_config())
    features = network.features(serves(2000)[0])
    assert features.mean(0).abs().max().item() < 1.5
    assert features.std(0).min().item() > 0.2
    assert features.std(0).max().item() < 1.5


def test_target_scaling_is_the_inverse_of_the_output_scaling() -> None:
    network = PredictorNetwork(predictor_config())
    positions = serves(50)[0]
    torch.testing.assert_close(
        network.scale_target(network(positions)), network.scaled(positions), atol=1e-5, rtol=1e-4
    )


def test_a_wrong_configuration_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"predictor\.outputs"):
        PredictorNetwork(predictor_config(outputs=["apex", "spin"]))
    with pytest.raises(ConfigError, match=r"predictor\.outputs"):
        PredictorNetwork(predictor_config(outputs=["target"]))
    with pytest.raises(ConfigError, match=r"predictor\.frames"):
        PredictorNetwork(predictor_config(frames=1))
