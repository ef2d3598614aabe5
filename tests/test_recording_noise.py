import numpy as np
import pytest

from bo_sysid.diagnosis.windows.channel_noise import channel_noise, timing_note
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.effects import survey
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording, noise_sigma, sensor_noise
from bo_sysid.recording.timing_noise import speeds, timing_noise
from bo_sysid.simulation import Engine


def clock(kind, size, rng):
    if kind == "even":
        return np.arange(size) * 0.01
    return np.cumsum(rng.uniform(0.004, 0.016, size))


@pytest.mark.parametrize("kind", ["even", "uneven"])
@pytest.mark.parametrize("sigma", [1e-5, 1e-2])
def test_noise_on_a_slow_signal_is_recovered(kind, sigma):
    rng = np.random.default_rng(0)
    time = clock(kind, 20_000, rng)
    values = 3e-4 * np.sin(0.3 * time) + 5.0 + sigma * rng.normal(size=time.size)
    assert noise_sigma(time, values) == pytest.approx(sigma, rel=0.04)


@pytest.mark.parametrize("kind", ["even", "uneven"])
def test_a_parabola_is_no_noise_on_any_grid(kind):
    time = clock(kind, 500, np.random.default_rng(1))
    values = 2.0 - 3.0 * time + 4.0 * time**2
    assert noise_sigma(time, values) < 1e-13 * np.ptp(values)


def test_jumps_and_gaps_do_not_count():
    rng = np.random.default_rng(2)
    time = np.arange(5000) * 0.01
    time[2500:] += 30.0
    values = 0.01 * rng.normal(size=5000)
    values[1000:] += 5.0
    values[2500:] += np.sin(time[2500:] * 0.1)
    assert noise_sigma(time, values) == pytest.approx(0.01, rel=0.06)


@pytest.mark.parametrize("kind", ["even", "uneven"])
def test_a_coarse_encoder_has_at_least_its_rounding_error(kind):
    time = clock(kind, 5000, np.random.default_rng(3))
    resolution = 2 * np.pi / 4096
    values = np.round(0.5 * np.sin(0.2 * time) / resolution) * resolution
    assert noise_sigma(time, values) == pytest.approx(resolution / np.sqrt(12), rel=0.5)


@pytest.mark.parametrize("kind", ["even", "uneven"])
def test_a_slow_log_of_fast_motion_is_not_all_noise(kind):
    rng = np.random.default_rng(5)
    time = clock(kind, 2000, rng) * 2.0  # 50 Hz
    values = np.sin(2 * np.pi * 2.0 * time) + 0.001 * rng.normal(size=time.size)
    assert noise_sigma(time, values) == pytest.approx(0.001, rel=0.08)


@pytest.mark.parametrize("ratio", [0.3, 0.9, 1.0, 2.0, 3.0])
def test_rounding_adds_its_variance_and_nothing_else(ratio):
    time, sigma = np.arange(10_000) * 0.002, 5e-4
    values = np.sin(3 * time) + sigma * np.random.default_rng(4).normal(size=time.size)
    rounded = np.round(values / (ratio * sigma)) * ratio * sigma
    expected = sigma * np.sqrt(1 + ratio**2 / 12)
    assert noise_sigma(time, rounded) == pytest.approx(expected, rel=0.05)


def test_nothing_can_be_said_about_a_frozen_or_tiny_channel():
    assert noise_sigma(np.arange(3.0), np.array([1.0, 5.0, 2.0])) == 0.0
    assert noise_sigma(np.arange(50.0), np.full(50, 3.0)) == 0.0


def test_sensor_noise_looks_at_measured_channels_only():
    time, values = np.arange(50.0), np.random.default_rng(4).normal(size=50)
    recording = Recording(
        "r", {"qpos.a": Channel(time, values), "ctrl.m": Channel(time, values, hold="zero")}
    )
    assert set(sensor_noise(recording)) == {"qpos.a"}


def test_noise_of_a_pose_is_what_its_numbers_have_all_in_all() -> None:
    """A robust scale takes 20 % too little of a number that is now near 1 and now near 0."""
    rng, time = np.random.default_rng(0), 0.005 * np.arange(4000)
    turn, tilt = 3.0 * np.sin(0.4 * time), 0.4 * np.sin(1.3 * time)
    pose = np.stack(
        [np.cos(turn / 2), np.sin(turn / 2) * np.sin(tilt), 0.2 * np.sin(time),
         np.sin(turn / 2) * np.cos(tilt)], axis=1
    )  # fmt: skip
    pose /= np.linalg.norm(pose, axis=1, keepdims=True)
    loud = pose + 5e-4 * rng.standard_normal(pose.shape)
    measured = loud / np.linalg.norm(loud, axis=1, keepdims=True)
    names = tuple(f"qpos.socket.{k}" for k in range(4))
    hung = Model.from_xml(
        '<mujoco><worldbody><body name="b"><joint name="socket" type="ball"/>'
        '<geom size=".1"/></body></worldbody></mujoco>'
    )
    for made in (measured, loud):
        log = Recording.from_arrays(time, qpos={"socket": made})
        found = channel_noise([log], survey(hung.compile(), [log]), {})
        error = np.sqrt(np.mean((made - pose) ** 2, axis=0))
        assert [found[n] for n in names] == pytest.approx(error, rel=0.05)


def motion(time: np.ndarray) -> np.ndarray:
    """Return positions of a joint that moves at up to some 10 rad/s."""
    rate, phase = 2 * np.pi * np.linspace(0.3, 2.5, 6), np.arange(6.0) ** 2
    return np.asarray(0.4 * np.sin(rate * time[:, None] + phase).sum(axis=1))


def stamped(jitter: float, *, late: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps that jitter, and a noisy motion that was sampled at them or beside them."""
    rng, even = np.random.default_rng(3), 0.005 * np.arange(4000)
    stamps = even + jitter * rng.standard_normal(len(even)).clip(-3, 3)
    return stamps, motion(even if late else stamps) + 5e-4 * rng.standard_normal(len(even))


@pytest.mark.parametrize("jitter", [2e-4, 4e-4, 8e-4])
def test_noise_of_late_stamps_is_split_into_rest_and_motion(jitter: float) -> None:
    found = timing_noise(*stamped(jitter, late=True))
    assert found is not None
    assert found.late == pytest.approx(jitter, rel=0.1)
    assert found.sigma == pytest.approx(5e-4, rel=0.25)


@pytest.mark.parametrize(("jitter", "late"), [(0.0, True), (2e-4, False), (8e-4, False)])
def test_stamps_that_say_when_samples_were_taken_add_no_noise(jitter: float, late: bool) -> None:
    assert timing_noise(*stamped(jitter, late=late)) is None


def test_a_coarse_encoder_that_rests_has_no_less_than_a_rounding_error() -> None:
    """Where it rests, as it does for half of the log, it shows one number."""
    stamps, _ = stamped(1e-3, late=True)
    even, count = 0.005 * np.arange(len(stamps)), 2 * np.pi / 8192
    measured = count * np.round(np.where(even % 4.0 < 2.0, 0.0, motion(even)) / count)
    found = timing_noise(stamps, measured)
    assert found is not None
    assert found.sigma >= count / np.sqrt(12) * (1 - 1e-9)


def test_speed_is_the_slope_of_a_motion() -> None:
    time = np.sort(np.random.default_rng(1).uniform(0, 2, 800))
    inner = slice(5, -5)
    found = speeds(time, np.sin(3 * time))
    assert found[inner] == pytest.approx(3 * np.cos(3 * time)[inner], abs=0.03)


def test_late_stamps_of_a_moving_joint_have_less_weight() -> None:
    """Residuals of a model that is the plant have size 1 at rest and in fast motion."""
    time, measured = stamped(8e-4, late=True)
    log = Recording.from_arrays(time, qpos={"a": measured}, ctrl={"m": np.zeros(len(time))})
    hung = Model.from_xml(
        '<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size=".1"/></body>'
        '</worldbody><actuator><motor name="m" joint="a"/></actuator></mujoco>'
    )
    machine = survey(hung.compile(), [log])
    sigma = channel_noise([log], machine, {})
    problem = cut_problem(hung, machine, [log], sigma, (), horizon=40, engine=Engine(1))
    w = problem.windows
    at = w.time[:, None] + (w.step + w.fraction) * w.timestep
    moved = motion(at.ravel())
    left = ((w.observed[..., 0].ravel() - moved) * problem.weight[..., 0].ravel()) ** 2
    fast = np.abs(np.interp(at.ravel(), time, speeds(time, measured))) > 4.0
    assert left[fast].mean() == pytest.approx(1.0, abs=0.2)
    assert left[~fast].mean() == pytest.approx(1.0, abs=0.2)
    assert timing_note([log], sigma)
    assert not timing_note([Recording.from_arrays(time, qpos={"a": 0 * time})], sigma)
