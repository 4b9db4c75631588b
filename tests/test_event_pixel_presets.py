"""The presets: every one works, and the paper's is the default."""

import numpy as np
import pytest

from evnlos.cameras import EventPixel, pixel_preset, simulate_events
from evnlos.cameras.sensors import PRESETS
from evnlos.errors import ConfigError


@pytest.mark.parametrize("name", PRESETS)
def test_presets_see_a_flash_in_both_modes(name):
    frames = np.full((20, 8, 9), 60, np.float32)  # as walls send them: no kernel is compiled for bytes
    frames[5:] = 180
    modes = ("exact", "v2e") if isinstance(pixel_preset(name), EventPixel) else ("exact",)
    for mode in modes:
        events = simulate_events(frames, np.arange(20) * 0.01, pixel_preset(name), mode=mode)
        assert events.p.sum() > 72


def test_the_papers_settings_are_the_default():
    assert pixel_preset("paper") == EventPixel()


def test_capital_letters_do_not_matter():
    assert pixel_preset("DAVIS346") == pixel_preset("davis346")
    with pytest.raises(ConfigError, match="did you mean 'davis346'"):
        pixel_preset("DAVIS364")


def test_a_wrong_name_names_the_nearest():
    with pytest.raises(ConfigError, match="davis346"):
        pixel_preset("davis364")
    with pytest.raises(ConfigError, match="celex_v"):
        pixel_preset("retina")
