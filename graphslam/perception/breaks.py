"""Where a run of returns breaks into two lines, by least squares over all places.

Split and merge tests single returns: a step or a bend of less than `split_m` escapes it, and it
breaks where one return is farthest out, not where the wall ends. A door in its niche beside a wall
then is one line with it, or a short oblique one with the wall's end: each turns with what is seen
of them, by far more than its covariance says. With all returns, breaks are a question of statistics
(R. E. Quandt, Tests of the hypothesis that a linear regression system obeys two separate regimes,
JASA 1960, DOI 10.1080/01621459.1960.10482067).
"""

import numpy as np

from graphslam.core.geometry import Array
from graphslam.perception.line_moments import fitted_lines, least_squares
from graphslam.perception.ordered_scan import Indices

#: m²: a divisor
TINY = 1e-12
#: m: rounding must not look like a break where settings know no noise
LEAST_SIGMA_M = 1e-4
#: returns that each part has at least: one line has two
FEWEST = 2
#: chance of a break where there is none. One too many costs a wall a little of its direction. One
#: too few, of a door 0.1 m behind its wall seen from 12 m, is a line turned by 0.07 rad from
#: wherever both are seen: seven of its sigmas, and always to the same side
FALSE_BREAK = 0.03


class Returns:
    """Moments of any run of returns: their sums up to each."""

    def __init__(self, moments: Array, variance: Array | float) -> None:
        """``moments`` (6, k): `point_moments` of all returns; ``variance`` (k,) of their ranges."""
        x, y = moments[1:3]
        each = np.vstack((moments, x * x, x * y, y * y))
        each[6:] *= variance / np.maximum(x * x + y * y, TINY)
        self._each, self._sums = each, np.cumsum(each, axis=1)

    def of(self, first: Indices, last: Indices) -> Array:
        """Moments (6, p) of runs from ``first`` (p,) to ``last`` (p,), both included."""
        return np.asarray(self._sums[:6, last] - self._sums[:6, first] + self._each[:6, first])

    def variance_across(self, first: Indices, last: Indices) -> Array:
        """Mean variances (p,), m², of returns across the lines of runs, by noise of the ranges."""
        nn = fitted_lines(self.of(first, last))[3:]  # a², 2ab, b² of the normals (a, b)
        beams = self._sums[6:, last] - self._sums[6:, first] + self._each[6:, first]
        return np.asarray((nn * beams).sum(axis=0) / (last - first + 1))

    def allowed_gain(self, first: Indices, last: Indices, least_sigma_m: float) -> Array:
        """By how much (p,), m², noise makes two lines fit runs better than one does, at most.

        Args:
            first: (p,) first return of each run.
            last: (p,) last, included.
            least_sigma_m: least noise of a return across a wall that beams graze.
        """
        across = self.variance_across(first, last)
        # chi-square with two degrees of freedom at each place
        gate = -2.0 * np.log(FALSE_BREAK / np.maximum(last - first, 1))
        return np.asarray(gate * np.maximum(across, max(least_sigma_m, LEAST_SIGMA_M) ** 2))

    def best_break(
        self, first: Indices, last: Indices, *, shared: bool = False
    ) -> tuple[Indices, Array]:
        """Last return (p,) of the first part of each run, and by how much it lessens the misfit.

        That is (p,) the sum of squared deviations, m². -1 and 0 for runs without two such parts.
        The second part begins with the next return, or with the same one where it is ``shared``.
        """
        at, gain = np.full(len(first), -1, dtype=np.intp), np.zeros(len(first))
        then = 0 if shared else 1
        tries = last - first + 3 - then - 2 * FEWEST
        long = np.flatnonzero(tries > 0)
        if not len(long):
            return at, gain
        a, b, n = first[long], last[long], tries[long]
        begins = np.cumsum(n) - n
        run = np.repeat(np.arange(len(n)), n)
        k = np.arange(len(run)) - begins[run] + a[run] + FEWEST - 1
        cost = least_squares(self.of(a[run], k)) + least_squares(self.of(k + then, b[run]))
        least = np.minimum.reduceat(cost, begins)
        best = np.flatnonzero(cost == least[run])
        at[long] = k[best[np.unique(run[best], return_index=True)[1]]]
        gain[long] = least_squares(self.of(a, b)) - least
        return at, gain


def without_breaks(
    returns: Returns, first: Indices, last: Indices, least_sigma_m: float
) -> tuple[Indices, Indices]:
    """Runs cut wherever they break: ``first`` and ``last`` (q,) of each.

    For the arguments see `Returns.allowed_gain`.
    """
    done_first, done_last = [first[:0]], [last[:0]]
    while len(first):
        at, gain = returns.best_break(first, last)
        cut = gain > returns.allowed_gain(first, last, least_sigma_m)
        done_first.append(first[~cut])
        done_last.append(last[~cut])
        a, k, b = first[cut], at[cut], last[cut]
        first, last = np.concatenate((a, k + 1)), np.concatenate((k, b))
    first, last = np.concatenate(done_first), np.concatenate(done_last)
    order = np.argsort(first, kind="stable")
    return first[order], last[order]


def moved_breaks(
    returns: Returns, first: Indices, last: Indices, rounds: int = 2
) -> tuple[Indices, Indices]:
    """Runs in order with the breaks between neighbours where they fit best.

    Neighbours share the return at which they break. All breaks move at once, so that the result
    does not depend on the direction of the scan; where two would pass each other, both stay.
    """
    first, last = first.copy(), last.copy()
    pair = np.flatnonzero(last[:-1] == first[1:])
    for _ in range(rounds):
        at, _ = returns.best_break(first[pair], last[pair + 1], shared=True)
        moves = at >= 0
        passed = (np.diff(pair) == 1) & (np.diff(at) < FEWEST - 1)
        moves[1:] &= ~passed
        moves[:-1] &= ~passed
        last[pair[moves]] = first[pair[moves] + 1] = at[moves]
    return first, last
