"""Simulate batches of drawn plants under the network, to train and to validate it."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.neural_law import Law, Network, Prior
from mptc_gym import Parameters
from mptc_gym.plant import Dynamics
from mptc_gym.torch_env import MiddlePointTorchEnv

NOMINAL = Parameters(time_constant_factor=[0.2, 5.0])  # a range, so that it can be changed
DYNAMICS = Dynamics(NOMINAL)
GAIN = abs(sum(NOMINAL.b) / sum(NOMINAL.a))  # degC per t/h
RATE = 1.0 - float(np.abs(np.roots(NOMINAL.a)).max())  # of the dominant pole
LONGEST, BLOCK = 44, 4  # samples: nominal delays lie from BLOCK to LONGEST - BLOCK

Numbers = dict[str, Tensor]


class Draw:
    """Random draws of a batch of plants, their set points and their nominal models."""

    def __init__(self, n: int, samples: int, spread: float, *seed: int) -> None:
        self._n, self._samples, self._spread = n, samples, spread
        self._generator = torch.Generator()
        # Hashed, so that neighbouring seeds give unrelated draws.
        state = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
        self._generator.manual_seed(int(state >> np.uint64(1)))

    def uniform(self, low: Any, high: Any, *shape: int) -> Tensor:
        """Draw uniformly, with shape (n,) by default."""
        drawn = torch.rand(*(shape or (self._n,)), generator=self._generator)
        values: Tensor = low + drawn * (high - low)
        return values

    def some(self, share: float, low: float, high: float) -> Tensor:
        """Draw uniformly for a share of the plants, and return 0 for the others."""
        return self.uniform(low, high) * (self.uniform(0.0, 1.0) < share)

    def plants(self) -> Numbers:
        """Draw the plants' numbers; `small` scales set point, dead zone, noise and load."""
        gain = torch.exp(self.uniform(math.log(0.7), math.log(1.7)))
        constant = torch.exp(self.uniform(math.log(0.45), math.log(2.2)))
        skewed = self.uniform(0.0, 1.0) < 0.25
        u_min = torch.where(skewed, -self.uniform(8.5, 13.0), -10.0)
        u_max = torch.where(skewed, self.uniform(8.5, 13.0), 10.0)
        small = torch.where(self.uniform(0.0, 1.0) < 0.25, self.uniform(0.1, 0.6), 1.0)
        kind = self.uniform(0.0, 1.0)  # calm, load alone, or everything
        loaded, noisy = small * (kind > 0.15), small**2 * (kind > 0.35)
        drifts = self.uniform(0.0, 1.0) < 0.2
        numbers = {
            "gain_factor": gain,
            "time_constant_factor": constant,
            "delay": self.uniform(6.0, 37.0).floor(),
            "dead_zone": self.some(0.9, 0.0, 8.0) * small,
            "u_min": u_min,
            "u_max": u_max,
            "noise_variance": self.some(0.85, 0.0, 1.0) * noisy,
            "measurement_noise_variance": self.some(0.5, 0.0, 0.2) * noisy,
            "disturbance_amplitude": self.some(0.45, 0.0, 2.5) * loaded,
            "disturbance_interval": self.uniform(100.0, 300.0),
            "disturbance_walk_variance": self.some(0.4, 0.0, 0.001) * noisy,
            "small": small,
            "gain_drift": torch.where(drifts, self.uniform(0.75, 1.33), 1.0),
            "time_constant_drift": torch.where(drifts, self.uniform(0.75, 1.33), 1.0),
        }
        return {**numbers, "setpoint": self.levels(numbers)}

    def levels(self, numbers: Numbers) -> Tensor:
        """Draw set points for k = 0 to `samples`: levels held for a while, or a square wave."""
        n, age = self._n, torch.arange(self._samples + 1)[:, None]
        room = torch.minimum(-numbers["u_min"], numbers["u_max"]) * GAIN
        most = (room * numbers["gain_factor"] * numbers["small"]).clamp(max=6.5)
        size = (0.3 + 0.65 * self.uniform(0.0, 1.0, self._samples // 60 + 2, n)) * most
        sign = torch.sign(self.uniform(-1.0, 1.0, *size.shape))
        begun, length = self.uniform(0.0, 150.0).floor(), self.uniform(60.0, 300.0).floor()
        number = ((age + begun) // length).long().clamp(max=len(size) - 1)
        held = (size * sign).gather(0, number)
        phase = self.uniform(0.0, 600.0).floor()
        square = torch.where((age + phase) // 300 % 2 == 0, size[0], -size[0])
        return torch.where(self.uniform(0.0, 1.0) < 0.5, square, held)

    def models(self, numbers: Numbers, *, exact: bool = False) -> Numbers:
        """Draw nominal models, of first order for 60 % of the plants, some of them wrong."""
        models = {name: numbers[name] for name in ("u_min", "u_max", "dead_zone")}
        models["first"] = self.uniform(0.0, 1.0) < 0.6
        k = self.some(0.0 if exact else 0.5, 0.0, self._spread)
        # Some numbers are out of date, which their uncertainty does not show.
        aged = self.some(0.0 if exact else 0.1, 0.0, 0.3)
        wrong = torch.randn(3, self._n, generator=self._generator) * k
        wrong[:2] += self.uniform(-1.5, 1.5, 2, self._n) * aged
        models["uncertainty"] = k
        models["gain_factor"] = numbers["gain_factor"] * torch.exp(wrong[0])
        constant = numbers["time_constant_factor"] * torch.exp(1.5 * wrong[1])
        models["time_constant_factor"] = constant.clamp(0.3, 3.3)
        delay = numbers["delay"] + (20.0 * wrong[2]).round()
        models["delay"] = delay.clamp(BLOCK, LONGEST - BLOCK)
        return models


def environment(
    n: int, samples: int, dtype: torch.dtype = torch.float32
) -> MiddlePointTorchEnv:
    """Return plants that take all numbers that differ between them as signals at each reset."""
    seen: Any = {
        "setpoint_window": 1,
        "error_window": 0,
        "output_window": 1,
        "action_window": 0,
    }
    options: Any = {"max_episode_steps": samples, "dtype": dtype, "differentiable": True}
    factors = "gain_factor", "gain_drift", "time_constant_drift"
    options |= dict.fromkeys(factors, (0.3, 3.0))
    return MiddlePointTorchEnv(
        n,
        **options,
        **seen,
        time_constant_factor=(0.2, 5.0),
        drift_samples=1200,
        delay=(4, 60),
        dead_zone=(0.0, 8.5),
        noise_variance=(0.0, 1.0),
        measurement_noise_variance=(0.0, 0.2),
        disturbance_amplitude=(0.0, 3.0),
        disturbance_interval=(50.0, 400.0),
        disturbance_walk_variance=(0.0, 0.001),
        u_min=(-14.0, -8.5),
        u_max=(8.5, 14.0),
    )


class _TorchLaw(Law):
    """The law in tensors."""

    _xp = torch

    @staticmethod
    def _stop_gradient(value: Tensor) -> Tensor:
        return value.detach()


class Loops:
    """Plants from rest under the network, the law and models of `NeuralSmithPredictor`."""

    def __init__(
        self, plants: MiddlePointTorchEnv, numbers: Numbers, models: Numbers, seed: int
    ) -> None:
        gain, constant = models["gain_factor"], models["time_constant_factor"]
        low, high, first = models["u_min"], models["u_max"], models["first"]
        self._plants, self._first = plants, first
        self._low, self._half = low, (high - low) / 2.0
        self._authority = gain * GAIN * self._half
        alpha, _, unit = DYNAMICS.coefficients(gain, constant)
        pole, zero = 1.0 - RATE / constant, torch.zeros_like(gain)
        unit = torch.where(first, 1.0 - pole, unit)
        self._alpha = torch.where(first, pole, alpha[0]), torch.where(first, zero, alpha[1])
        newer, older = (unit * (b / sum(NOMINAL.b)) for b in NOMINAL.b)
        self._beta = torch.where(first, unit, newer), torch.where(first, zero, older)
        self._delay = models["delay"].long()
        prior = Prior(
            unit=unit,
            fading=pole ** (models["delay"] + 1.0 + 0.5 * first),
            time_constant=constant,
            delay=models["delay"],
            dead_zone=models["dead_zone"] / self._half,
            centre=-(high + low) / (high - low),
            uncertainty=models["uncertainty"],
        )
        self._law = _TorchLaw(prior)
        self._before = torch.zeros(LONGEST + BLOCK, len(gain))  # the model's outputs
        self._new: list[Tensor] = []
        self._model = self._last_model = self._flow = self._last_flow = zero
        self._residual = self._last_residual = self._off = zero
        signals = {name: values for name, values in numbers.items() if name != "small"}
        self._observations, _ = plants.reset(seed=seed, options={"signals": signals})

    def run(self, net: Network, samples: int) -> tuple[Tensor, Tensor]:
        """Return e(k + 1) of the authority and u_a(k) of half the range, (samples, n).

        It goes on from the last call, behind which gradients do not reach.
        """
        self._plants.detach()
        for owner in (self, self._law):
            for name, value in vars(owner).items():
                if isinstance(value, Tensor):
                    setattr(owner, name, value.detach())
        self._new = [each.detach() for each in self._new]
        errors, applied = [], []
        for _ in range(samples):
            self._observations, _, _, _, infos = self._plants.step(self._act(net))
            errors.append(infos["error"])
            applied.append(infos["applied"])
        return torch.stack(errors) / self._authority, torch.stack(applied) / self._half

    def _act(self, net: Network) -> Tensor:
        """Return actions, shape (n, 1)."""
        setpoint, output = (self._observations / self._authority[:, None]).unbind(1)
        k = len(self._new) % BLOCK
        if k == 0:  # looked up a block at a time, which is cheaper
            if self._new:
                self._before = torch.cat([self._before[BLOCK:], torch.stack(self._new)])
                self._new = []
            rows = len(self._before) - self._delay + torch.arange(BLOCK)[:, None]
            self._delayed = self._before.gather(0, rows).unbind()
        off = output - self._delayed[k]
        residual = torch.where(self._first, (off + self._off) / 2.0, off)
        self._off = off
        load = residual - self._alpha[0] * self._residual - self._alpha[1] * self._last_residual
        self._residual, self._last_residual = residual, self._residual
        state = self._model, self._last_model, self._flow
        wanted, passed = self._law.applied(self._law.flow(net, setpoint, residual, load, state))
        self._new.append(self._model)
        self._flow, self._last_flow = passed, self._flow
        new = self._alpha[0] * self._model + self._alpha[1] * self._last_model
        new = new + self._beta[0] * self._flow + self._beta[1] * self._last_flow
        self._model, self._last_model = new, self._model
        # The plant's gain is negative.
        action: Tensor = (-wanted * self._half - self._low) / self._half - 1.0
        return action[:, None]
