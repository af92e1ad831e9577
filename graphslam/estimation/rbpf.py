"""A Rao-Blackwellised particle filter: paths are sampled, everything else is Gaussian in each.

Given the path, landmarks are independent of each other (K. Murphy, NIPS 1999), so a particle has
a small Kalman filter for each. The pose is drawn late and knowingly: as in FastSLAM 2.0
(M. Montemerlo et al., IJCAI 2003; S. Thrun et al., Probabilistic Robotics, 2005, chapter 13.8) it
is drawn after the sightings of the step have corrected it, and only if there are any of landmarks;
until then it is a Gaussian in each particle, over the latest poses of all robots together. So
odometry alone costs no samples, and a meeting of robots is an ordinary Kalman update.

All arrays have the particles, N of them, in front; nothing loops over particles. What a filter
without a past cannot use is left out and counted, as in `graphslam.estimation.ekf`; there is no
robust kernel.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.core.geometry import Array, compose, compose_jacobians, rotate_cov, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Closure, Estimate, Motion, Start, Step, Trajectory
from graphslam.estimation.backend import Joint, StateTable, block_slices
from graphslam.estimation.factors import FILTER_GAUGE_SIGMA_M
from graphslam.estimation.input_checks import check_finite, indeterminate, sighting

#: resample once the effective number of particles is below this share of them
LEAST_EFFECTIVE = 0.5


def low_variance(weights: Array, share: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Which particles survive, N numbers: each as often as its weight times N, rounded up or down.

    One draw for all (J. Carpenter et al., IEE Proc. Radar Sonar Navig. 146(1), 1999,
    https://doi.org/10.1049/ip-rsn:19990255).

    Args:
        weights: (N,), sum 1.
        share: uniformly drawn from [0, 1).
    """
    n = len(weights)
    edges = np.cumsum(weights)
    inner = edges[:-1] / edges[-1]  # the last edge is 1, also where the last place rounds to 1
    return np.searchsorted(inner, (np.arange(n) + share) / n, side="right")


@dataclass(slots=True)
class _Landmark:
    """Means (N, d) and covariances (N, d, d)."""

    mean: Array
    cov: Array


class RbpfBackend:
    """The filter. ``joint`` and ``finish`` give mean and covariance of the mixture."""

    smooths = False
    error_frame: Literal["body", "world"] = "world"

    def __init__(self, config: Config) -> None:
        self._count, self._proposal = config.rbpf.particles, config.rbpf.proposal
        self._rng = np.random.default_rng(config.rbpf.seed)
        self._states = StateTable()
        self._blocks: dict[str, slice] = {}  # of each robot in x and P
        self._x = np.zeros((self._count, 0))
        self._P = np.zeros((self._count, 0, 0))
        self._landmarks: dict[int, _Landmark] = {}
        self._log_weights = np.zeros(self._count)
        self._weights = np.full(self._count, 1 / self._count)
        self._track: dict[str, list[tuple[Array, Array]]] = {}
        self._twice_error, self._dof = 0.0, 0
        self.skipped: Counter[str] = Counter()

    # ------------------------------------------------------------ evidence in

    def add(self, step: Step) -> None:
        """See `Backend`.

        Raises:
            EstimationError: a state that was never made, or noise without a valid covariance.
        """
        for robot, start in step.starts.items():
            self._start(robot, step.time_ns, start)
        for robot, motion in step.motions.items():
            self._move(robot, step.time_ns, motion)
        seen = [s for s in step.associations if self._usable(s, step.time_ns)]
        closures = [c for c in step.closures if self._is_now(c)]
        if seen or closures:
            self._take(seen, closures)
        for robot in {**step.starts, **step.motions}:
            joint = self.joint(robot, ())
            self._track.setdefault(robot, []).append((joint.pose, joint.cov))

    def _start(self, robot: str, time_ns: int, start: Start) -> None:
        check_finite(f"start of robot {robot} at {time_ns} ns", start.pose, start.cov)
        self._states.append(robot, time_ns)
        n = self._x.shape[1]
        block = self._blocks[robot] = slice(n, n + 3)
        self._x = np.pad(self._x, ((0, 0), (0, 3)))
        self._P = np.pad(self._P, ((0, 0), (0, 3), (0, 3)))
        self._x[:, block], self._P[:, block, block] = start.pose, start.cov

    def _move(self, robot: str, time_ns: int, motion: Motion) -> None:
        """Thesis 4.4-4.17 in each particle; the covariance is zero where the pose was drawn."""
        self._states.latest(robot, time_ns)  # has it started?
        check_finite(f"motion of robot {robot} to {time_ns} ns", motion.delta, motion.cov)
        self._states.append(robot, time_ns)
        block, P = self._blocks[robot], self._P
        F, W = compose_jacobians(self._x[:, block], motion.delta)
        P[:, block] = F @ P[:, block]
        P[:, :, block] = P[:, :, block] @ F.mT
        P[:, block, block] += W @ motion.cov @ W.mT
        self._x[:, block] = compose(self._x[:, block], motion.delta)

    def _take(self, seen: Sequence[Association], closures: Sequence[Closure]) -> None:
        """Everything that was seen in a step: meetings, then one robot after the other."""
        for s in seen:
            if isinstance(s.target, str):
                with _named(sighting(s)):
                    self._correct(s.robot, s.target, s.model, s.z, s.cov)
        for c in closures:
            with _named(f"closure of robot {c.robot} at {c.time_ns} ns"):
                self._correct(c.other, c.robot, "robot-pose", c.delta, c.cov)
        for robot in sorted({s.robot for s in seen}):
            mine = [(s, s.target) for s in seen if s.robot == robot and isinstance(s.target, int)]
            if mine:
                self._chart(robot, mine)
        self._weigh()

    def _chart(self, robot: str, mine: Sequence[tuple[Association, int]]) -> None:
        """The landmarks that a robot saw: they correct its pose, it is drawn, it corrects them."""
        if self._proposal == "motion":
            self._draw(robot)
        # a second sighting of the same landmark is not independent until the first corrected it
        first = {target: s for s, target in reversed(mine) if target in self._landmarks}
        for target, s in first.items():
            with _named(sighting(s)):
                self._correct(robot, target, s.model, s.z, s.cov)
        if self._proposal == "observation":
            self._draw(robot)
        for s, target in mine:
            with _named(sighting(s)):
                if target in self._landmarks:
                    self._map(s, target, weigh=s is not first.get(target))
                else:
                    self._augment(s, target)

    def _correct(self, source: str, target: int | str, model: str, z: Array, cov: Array) -> None:
        """Kalman update of the poses by a sighting, whose landmark is uncertain, too; weigh."""
        row, block = MODELS[model], self._blocks[source]
        z, R = self._each(z), self._each(cov)
        x = self._x[:, block]
        if isinstance(target, str):
            t = self._x[:, self._blocks[target]]
        else:
            t = self._landmarks[target].mean
        H_x, H_t = row.jacobians(z, x, t)
        H = np.zeros((self._count, row.rows, self._x.shape[1]))
        H[:, :, block] = H_x
        R = row.noise(z, R, x, t)
        np.linalg.cholesky(R[0])  # raises if it is no covariance, which is so in all or in none
        if isinstance(target, str):
            H[:, :, self._blocks[target]] = H_t
        else:
            R = R + H_t @ self._landmarks[target].cov @ H_t.mT
        self._score(*_update(self._x, self._P, H, R, -row.residual(z, x, t)), row.rows)

    def _draw(self, robot: str) -> None:
        """Draw the latest pose of a robot, given which the others are better known.

        Along axes without uncertainty (a robot that stood still) nothing is drawn.
        """
        block = self._blocks[robot]
        values, axes = np.linalg.eigh(self._P[:, block, block])
        sigmas = np.sqrt(np.maximum(values, 0.0))
        floor = 1e-9 * sigmas[:, -1:]  # below it an axis is rounding
        inverse = np.divide(1.0, sigmas, out=np.zeros_like(sigmas), where=sigmas > floor)
        shared = self._P[:, :, block] @ (axes * inverse[:, None])  # of all poses with the draws
        normal = self._rng.standard_normal((self._count, 3, 1))
        self._x += (shared @ normal)[..., 0]
        self._P -= shared @ shared.mT
        self._P[:, block] = 0.0  # to the digit
        self._P[:, :, block] = 0.0

    def _augment(self, seen: Association, target: int) -> None:
        """A new landmark in each particle, 4.24-4.28 with the pose known."""
        row, cov = MODELS[seen.model], seen.cov
        if seen.model == "line":  # where on the line is a gauge
            cov = rotate_cov(cov, -seen.z[2])
            cov[0, :] = cov[:, 0] = 0.0
            cov[0, 0] = FILTER_GAUGE_SIGMA_M**2
            cov = rotate_cov(cov, seen.z[2])
        x, z = self._x[:, self._blocks[seen.robot]], self._each(seen.z)
        _, G = row.invert_jacobians(z, x)
        fresh = G @ cov @ G.mT
        np.linalg.cholesky(fresh)  # raises where the sighting does not say where it is
        self._landmarks[target] = _Landmark(row.invert(z, x), fresh)

    def _map(self, seen: Association, target: int, weigh: bool) -> None:
        """Kalman update of a landmark in each particle, with the pose known."""
        row, landmark = MODELS[seen.model], self._landmarks[target]
        x, z = self._x[:, self._blocks[seen.robot]], self._each(seen.z)
        _, H = row.jacobians(z, x, landmark.mean)
        R = row.noise(z, self._each(seen.cov), x, landmark.mean)
        np.linalg.cholesky(R[0])  # as in `_correct`
        innovation = -row.residual(z, x, landmark.mean)
        scores = _update(landmark.mean, landmark.cov, H, R, innovation)
        if weigh:
            self._score(*scores, row.rows)

    def _score(self, d2: Array, log_det: Array, rows: int) -> None:
        """Weigh each particle by how probable the innovation was."""
        self._log_weights -= 0.5 * (d2 + log_det)
        self._twice_error += float(self._weights @ d2)
        self._dof += rows

    def _weigh(self) -> None:
        """Normalise the weights; resample if too few particles carry them."""
        self._log_weights -= self._log_weights.max()
        weights = np.exp(self._log_weights)
        self._weights = weights / weights.sum()
        if 1 / np.sum(np.square(self._weights)) < LEAST_EFFECTIVE * self._count:
            kept = low_variance(self._weights, self._rng.random())
            self._x, self._P = self._x[kept], self._P[kept]
            for landmark in self._landmarks.values():
                landmark.mean, landmark.cov = landmark.mean[kept], landmark.cov[kept]
            self._log_weights = np.zeros(self._count)
            self._weights = np.full(self._count, 1 / self._count)

    def _usable(self, seen: Association, time_ns: int) -> bool:
        """Whether a sighting is of now; counts what is not."""
        current = self._is_latest(seen.robot, seen.time_ns)
        if isinstance(seen.target, str):
            current &= self._is_latest(seen.target, time_ns)
        if seen.late:
            self.skipped["late evidence"] += 1
        elif not current:
            self.skipped["observation from a past state"] += 1
        else:
            check_finite(sighting(seen), seen.z, seen.cov)
            return True
        return False

    def _is_now(self, closure: Closure) -> bool:
        """Whether both ends of a closure are now; counts what is not."""
        latest = self._is_latest(closure.robot, closure.time_ns)
        if not self._is_latest(closure.other, closure.other_time_ns) or not latest:
            self.skipped["closure to a past state"] += 1
            return False
        what = f"closure of robot {closure.robot} at {closure.time_ns} ns"
        check_finite(what, closure.delta, closure.cov)
        return True

    def _is_latest(self, robot: str, time_ns: int) -> bool:
        return self._states.number(robot, time_ns) == self._states.latest(robot)

    def _each(self, value: Array) -> Array:
        """The same for every particle, (N, ...)."""
        return np.broadcast_to(value, (self._count, *value.shape))

    # ------------------------------------------------------------ knowledge out

    def joint(self, robot: str, landmarks: Sequence[int], others: Sequence[str] = ()) -> Joint:
        """See `Backend`; mean and covariance of the mixture.

        Within one particle, landmarks are independent of each other and of all latest poses.

        Raises:
            EstimationError: it is not known.
        """
        robots = [robot, *others]
        parts = [self._poses(robot), *(self._known(i).mean for i in landmarks)]
        parts += [self._poses(other) for other in others]
        means, off = zip(*(self._moments(part) for part in parts), strict=True)
        slices = block_slices([len(mean) for mean in means[1:]])
        E = np.concatenate(off, axis=1)
        cov = (self._weights * E.T) @ E
        n = len(landmarks)
        for place, i in zip(slices, landmarks, strict=False):
            cov[place, place] += self._within(self._known(i).cov)
        index = np.concatenate([np.r_[self._blocks[name]] for name in robots])
        places = np.concatenate([np.r_[place] for place in (slice(0, 3), *slices[n:])])
        cov[np.ix_(places, places)] += self._within(self._P[:, index[:, None], index])
        return Joint(
            means[0], tuple(means[1 : n + 1]), 0.5 * (cov + cov.T), slices, tuple(means[n + 1 :])
        )

    def _poses(self, robot: str) -> Array:
        """The robot's latest poses (N, 3)."""
        self._states.latest(robot)  # has it started?
        return self._x[:, self._blocks[robot]]

    def _known(self, landmark: int) -> _Landmark:
        if landmark not in self._landmarks:
            raise EstimationError(
                f"landmark {landmark} is not in the filter: all that was seen of it belonged to "
                "the past"
            )
        return self._landmarks[landmark]

    def _moments(self, values: Array) -> tuple[Array, Array]:
        """Weighted mean (d,) of values (N, d) and how far off each is; a third column is angles."""
        origin = values[np.argmax(self._weights)]
        off = values - origin
        off[:, 2:] = wrap(off[:, 2:])
        shift = self._weights @ off
        mean = origin + shift
        mean[2:] = wrap(mean[2:])
        return mean, off - shift

    def _within(self, covs: Array) -> Array:
        """Weighted mean (d, d) of the particles' own covariances (N, d, d)."""
        return np.asarray(np.tensordot(self._weights, covs, axes=1))

    def state_mean(self, robot: str) -> Array:
        """See `Backend`."""
        return self._moments(self._poses(robot))[0]

    def landmark_means(self, landmarks: Sequence[int]) -> list[Array]:
        """See `Backend`."""
        return [self._moments(self._known(i).mean)[0] for i in landmarks]

    def finish(self) -> Estimate:
        """See `Backend`: final states are the causal ones.

        Surviving particles have a past that could be told as a smoothed path, but they soon share
        one ancestor, and its covariance would be none. The error is half the sum of the squared
        normalised innovations, averaged over the particles of their time.
        """
        states = {
            robot: Trajectory(
                self._states.stamps(robot),
                np.array([pose for pose, _ in track]),
                np.array([cov for _, cov in track]),
            )
            for robot, track in sorted(self._track.items())
        }
        landmarks = {}
        for i, landmark in self._landmarks.items():
            mean, off = self._moments(landmark.mean)
            cov = (self._weights * off.T) @ off + self._within(landmark.cov)
            landmarks[i] = (mean, 0.5 * (cov + cov.T))
        return Estimate(states, landmarks, 0.5 * self._twice_error, self._dof)


def _update(x: Array, P: Array, H: Array, R: Array, innovation: Array) -> tuple[Array, Array]:
    """Kalman update in place, thesis 3.5-3.8, of N Gaussians at once.

    Args:
        x: means (N, n).
        P: covariances (N, n, n).
        H: measurement matrices (N, k, n).
        R: covariances (N, k, k).
        innovation: (N, k).

    Returns:
        Squared normalised innovations (N,) and log determinants of their covariances (N,).

    Raises:
        numpy.linalg.LinAlgError: a covariance is none.
    """
    L = np.linalg.cholesky(H @ P @ H.mT + R)
    solved = np.linalg.solve(L, np.concatenate([H @ P, innovation[..., None]], axis=-1))
    B, w = solved[..., :-1], solved[..., -1:]
    x += (B.mT @ w)[..., 0]
    P -= B.mT @ B
    log_det = 2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
    return np.square(w[..., 0]).sum(axis=1), log_det


@contextmanager
def _named(what: str) -> Iterator[None]:
    """A covariance that is none becomes an error that says where."""
    try:
        yield
    except np.linalg.LinAlgError:
        raise indeterminate(what) from None
