"""What no sensor of a wheeled robot measures: messages beyond are dropped and counted.

They are errors of drivers (codes such as 1e6, 65535, 1e30) or damage, and one of them can spoil a
whole map, or the arithmetic. The limits are far from all that is known to be real.
"""

#: planar lasers, m
MAX_RANGE_M = 1000.0
#: bearing and range to a landmark, also by radio, m
MAX_SIGHTING_M = 1e5
#: nearer a landmark has no bearing, m: at 1e-9 an estimate is indeterminate, at 2e-6 it is not
MIN_SIGHTING_M = 1e-6
#: sensors on a robot, m from its base
MAX_MOUNT_M = 1000.0
#: no planar laser takes longer for a sweep, s; it may take so much more of the time that is stated
MAX_SWEEP_S, SWEEP_SLACK = 1.0, 1.05
#: positions in a frame, which may be that of a map of the Earth (UTM), and relative poses, m
MAX_POSITION_M = 1e8
#: angles that add up: years of turning wheels, rad
MAX_ANGLE_RAD = 1e9
#: variances of sightings: a sigma of 100 km tells nothing; of relative poses, in which a direction
#: that was not measured is stated like that: beyond, arithmetic fails
MAX_SIGHTING_VARIANCE, MAX_VARIANCE, MIN_VARIANCE = 1e10, 1e24, 1e-24
