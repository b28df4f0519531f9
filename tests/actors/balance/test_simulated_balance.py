"""`simulated_balance`: the virtual balance behaves as its data sheet says, and a pour's seed decides every reading."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
import pytest

from actors.balance.scale_model import Load
from actors.balance.simulated_balance import SimulatedBalanceSettings, VirtualBalance
from actors.interfaces import LaboratoryError

SHEET = SimulatedBalanceSettings(resolution=1e-4, noise=2e-4, drift=0.0, settling_time=1.5, time_scale=0.0)


def balance(seed: int = 1, **changes: float) -> VirtualBalance:
    made = VirtualBalance(SHEET.with_values(**changes))
    made.prepare((seed,))
    return made


def on_tray(device: VirtualBalance, mass: float) -> None:
    device.put(Load((0.0,), (mass,)))


def test_weights_scatter_by_noise_and_resolution_about_the_true_mass():
    device = balance(resolution=5e-4)
    on_tray(device, 0.0123)
    device.pass_time(10.0)
    weights = np.array([device.weigh().mass for _ in range(400)])
    expected = math.sqrt(2e-4**2 + 5e-4**2 / 12)
    assert abs(weights.mean() - 0.0123) < 4 * expected / 20
    # The standard deviation of 400 samples is known to 1/sqrt(2·400) = 3.5 %; the rounding is not quite uniform.
    assert weights.std() == pytest.approx(expected, rel=0.2)
    assert np.allclose(weights / 5e-4, np.round(weights / 5e-4), atol=1e-6)


def test_display_comes_within_a_hundredth_in_the_settling_time():
    device = balance(noise=0.0, resolution=0.0)
    on_tray(device, 1.0)
    device.pass_time(1.5)
    assert device.read().mass == pytest.approx(0.99, abs=1e-6)


def test_a_display_in_motion_is_not_called_stable():
    device = balance(noise=0.0)
    on_tray(device, 0.1)
    device.pass_time(0.3)
    assert not device.read().stable
    assert device.read().mass < 0.09
    weight = device.weigh()
    assert weight.stable
    assert weight.mass == pytest.approx(0.1, abs=2e-4)


def test_zero_drifts_with_time_and_a_new_tare_takes_it_away():
    device = balance(noise=0.0, drift=1e-5)
    device.tare()
    device.pass_time(100.0)
    assert device.weigh().mass == pytest.approx(1e-3, abs=2e-4)
    device.tare()
    assert device.weigh().mass == pytest.approx(0.0, abs=2e-4)


def test_a_load_that_never_rests_is_reported_with_its_last_reading():
    device = balance(noise=0.0)
    device.put(Load((0.0, 100.0), (0.0, 1.0)))
    with pytest.raises(LaboratoryError, match=r"no stable weight within 20 s .*g, unstable.*touching the tray"):
        device.weigh()


def test_same_seed_weighs_the_same_whoever_looks_at_the_display_meanwhile():
    def weighings(device: VirtualBalance, glances: int) -> list[float]:
        device.prepare((7,))
        on_tray(device, 0.02)
        masses = []
        for _ in range(5):
            masses += [device.weigh().mass]
            for _ in range(glances):
                device.read()
        return masses

    used = balance(seed=3)
    used.weigh()
    assert weighings(used, 10) == weighings(balance(seed=99), 0)
    other = balance()
    other.prepare((8,))
    on_tray(other, 0.02)
    assert [other.weigh().mass for _ in range(5)] != weighings(balance(), 0)


def test_bench_time_passes_at_the_stated_scale_and_an_interrupt_ends_the_wait():
    device = balance(time_scale=50.0)
    started = time.monotonic()
    device.pass_time(10.0)
    assert time.monotonic() - started >= 0.2

    threading.Timer(0.1, device.interrupt).start()
    with pytest.raises(LaboratoryError, match="interrupted"):
        device.pass_time(1e6)
    device.prepare((1,))
    device.pass_time(1.0)
