"""The information that a policy acts on."""

import pytest

from baselines.policies.information import information


@pytest.mark.parametrize(
    ("settings", "centralized", "seen"),
    [
        ({"observation": "lidar"}, False, "all"),
        ({"observation": "lidar_local"}, False, "own sight"),
        ({"observation": "lidar_local"}, True, "all"),
        ({"dropout": 1.0}, False, "own sight"),
        ({"dropout": 1.0}, True, "own sight"),
        ({"observation": "entities", "knowledge": "own"}, False, "own"),
        ({"observation": "entities", "knowledge": "own"}, True, "team"),
        ({"observation": "entities"}, False, "all"),
        ({"observation": "entities", "assignment": "fresh"}, False, "assignment"),
    ],
)
def test_what_a_policy_sees_has_a_name(settings, centralized, seen):
    assert information(settings, centralized=centralized) == seen
