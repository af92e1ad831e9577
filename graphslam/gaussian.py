"""What squared distances of normal errors may be, without the second that scipy.stats loads in."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from graphslam.geometry import Array


def chi2_quantile(probability: ArrayLike, dof: ArrayLike) -> Array:
    """Value (...,) that chi-square of ``dof`` degrees of freedom stays below with a probability."""
    return np.asarray(chdtri(dof, 1.0 - np.asarray(probability)))
