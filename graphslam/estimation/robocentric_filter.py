"""Kalman filter of a few landmarks around one robot, in the robot's own frame.

The state are the landmarks of the last metres of path and the previous pose, all seen from the
present pose. A motion moves all of them; observations are of landmarks in the robot's frame, so
they are linear in what is uncertain. Nothing is known about the world frame, so the errors stay as
small as the neighbourhood, however long the path is: the filter is consistent where one in a world
frame is not. Source: J. Castellanos, R. Martinez-Cantin, J. Tardós, J. Neira, Robocentric map
joining, Robotics and Autonomous Systems 55(1), 2007, https://doi.org/10.1016/j.robot.2006.06.005.
"""

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.gaussian import symmetric, whiten
from graphslam.core.geometry import Array, between, inverse, rotation3, wrap

#: the first two members: the previous pose, and the anchor
PREVIOUS, ANCHOR = 0, 1
#: members in front of the landmarks
REFERENCES = 2


class RobocentricFilter:
    """Members are poses (3,) in the robot's frame: two reference poses, then landmarks.

    ``x`` (n, 3) are the means and ``P`` (3n, 3n) the covariance of additive errors along the
    robot's axes. `PREVIOUS` is the pose before the latest motion; `ANCHOR` the pose at which
    `set_anchor` was last called. Points have heading 0 and no variance in it.
    """

    def __init__(self) -> None:
        self.x = np.zeros((REFERENCES, 3))
        self.P = np.zeros((3 * REFERENCES, 3 * REFERENCES))
        self._turns = np.ones(REFERENCES)  # 0 for points, which have no heading

    def __len__(self) -> int:
        """Number of landmarks."""
        return len(self.x) - REFERENCES

    @property
    def landmarks(self) -> Array:
        """Means (n, 3) of the landmarks; a view."""
        return self.x[REFERENCES:]

    def blocks(self) -> Array:
        """Covariances (n, 3, 3) of the landmarks by themselves."""
        n = len(self.x)
        own = self.P.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
        return own[REFERENCES:]

    def reference(self, which: int) -> tuple[Array, Array]:
        """Pose (3,) of the robot seen from a reference pose, and its covariance (3, 3)."""
        seen, own = self.x[which], slice(3 * which, 3 * which + 3)
        pose = inverse(seen)
        # error of the inverse: -R(-heading) of (translation), with the lever arm of the turn
        J = -rotation3(-seen[2])
        J[0, 2], J[1, 2] = pose[1], -pose[0]
        return pose, J @ self.P[own, own] @ J.T

    def set_anchor(self) -> None:
        """The present pose becomes the anchor."""
        own = slice(3 * ANCHOR, 3 * ANCHOR + 3)
        self.x[ANCHOR] = 0.0
        self.P[own] = self.P[:, own] = 0.0

    def predict(self, delta: Array, cov: Array) -> None:
        """The robot moved by ``delta`` (3,) with covariance (3, 3), along the axes of its start."""
        own = slice(3 * PREVIOUS, 3 * PREVIOUS + 3)
        self.x[PREVIOUS] = 0.0
        self.P[own] = self.P[:, own] = 0.0
        n = len(self.x)
        moved = between(delta, self.x)
        R = rotation3(-delta[2])
        turned = (R @ self.P.reshape(n, 3, 3 * n)).reshape(3 * n, 3 * n)
        turned = (R @ np.ascontiguousarray(turned.T).reshape(n, 3, 3 * n)).reshape(3 * n, 3 * n)
        # an error of the motion moves everything the other way, with the lever arm of its turn
        G = np.broadcast_to(-R, (n, 3, 3)).copy()
        G[:, 0, 2], G[:, 1, 2] = moved[:, 1], -moved[:, 0]
        points = self._turns == 0.0
        moved[points, 2] = 0.0
        G[points, 2] = 0.0
        G = G.reshape(3 * n, 3)
        self.x, self.P = moved, symmetric(turned + G @ cov @ G.T)

    def update(
        self, landmarks: IntArray, H: Array, R: Array, residuals: Array, rows: BoolArray
    ) -> None:
        """Kalman update with k observations of different landmarks, thesis 3.5-3.8.

        Args:
            landmarks: (k,) their indices.
            H: (k, 3, 3) derivatives of the residuals by the landmarks.
            R: (k, 3, 3) noise of the residuals.
            residuals: (k, 3) expected minus measured.
            rows: (k, 3) which rows of each count.
        """
        k, n = len(landmarks), len(self.x)
        full = np.zeros((k, 3, n, 3))
        full[np.arange(k), :, landmarks + REFERENCES] = H
        used = rows.ravel()
        J = full.reshape(3 * k, 3 * n)[used]
        noise = np.zeros((k, 3, k, 3))
        noise[np.arange(k), :, np.arange(k)] = R
        PJt = self.P @ J.T
        S = J @ PJt + noise.reshape(3 * k, 3 * k)[np.ix_(used, used)]
        B, w, _ = whiten(PJt, S, -residuals.ravel()[used])
        self.x += (w @ B).reshape(n, 3)
        self.x[:, 2] = wrap(self.x[:, 2])
        self.P -= B.T @ B

    def add(self, means: Array, covs: Array, turns: Array) -> None:
        """New landmarks: means (k, 3), covariances (k, 3, 3), and (k,) 1.0, or 0.0 for points."""
        n, k = len(self.x), len(means)
        P = np.zeros((3 * (n + k), 3 * (n + k)))
        P[: 3 * n, : 3 * n] = self.P
        new = np.zeros((k, 3, k, 3))
        new[np.arange(k), :, np.arange(k)] = covs
        P[3 * n :, 3 * n :] = new.reshape(3 * k, 3 * k)
        self.x, self.P = np.concatenate([self.x, means]), P
        self._turns = np.append(self._turns, turns)

    def keep(self, landmarks: IntArray) -> None:
        """Forget all landmarks but those of indices (k,); the others keep their joint marginal."""
        kept = np.concatenate([np.arange(REFERENCES), np.asarray(landmarks) + REFERENCES])
        at = (3 * kept[:, None] + np.arange(3)).ravel()
        self.x, self.P, self._turns = self.x[kept], self.P[np.ix_(at, at)], self._turns[kept]
