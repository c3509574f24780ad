"""Loader settings: stated once, checked once, and flat keys of every data module."""

from __future__ import annotations

import dataclasses
import typing

import pytest

from saunet import schema
from saunet.data.loading.options import Loading, LoadOptions
from saunet.errors import ConfigError
from saunet.registry import datamodules


def test_the_keywords_are_the_fields():
    assert typing.get_type_hints(Loading) == typing.get_type_hints(LoadOptions)


@pytest.mark.parametrize("entry", datamodules, ids=lambda entry: entry.name)
def test_every_data_module_takes_them_as_flat_keys(entry):
    parameters = schema.parameters(entry.target)
    for field in dataclasses.fields(LoadOptions):
        assert parameters[field.name].default == field.default


@pytest.mark.parametrize(
    "option",
    [
        {"height": 0},
        {"batch_size": -1},
        {"workers": -1},
        {"crop_margin": 2.0},
        {"flip_prob": 2.0},
        {"color_jitter_prob": -0.1},
        {"offsets": (0,)},
        {"offsets": (1, 1)},
        {"seed": -1},
    ],
    ids=str,
)
def test_values_out_of_range_are_refused(option):
    with pytest.raises(ConfigError, match=next(iter(option))):
        LoadOptions(**option)


def test_campus_is_video_with_the_height_of_the_papers_camera(tmp_path):
    entry = datamodules.entry("campus")
    assert entry.target is datamodules.entry("video").target
    assert entry.preset["camera_height"] == 1.20
