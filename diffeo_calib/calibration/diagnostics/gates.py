"""The gates of every diagnosis: from where something is doubted, warned about, refused or named.

A relative residual is a median distance divided by the spread of the markers; lengths of a campaign are relative to the
largest distance of the tip from the base. A chance is the probability that right rows show as much.
"""

from __future__ import annotations

JUDGED_COORDINATES = 2000
"""Measured coordinates of the random rows that stand for all where there are more."""

# --- what changed during the measurements ---

CHANGE_ROWS = 5
"""Smallest number of rows on either side of a change."""
CHANGE_EVIDENCE = 24.0
"""Gain less the price of its unknowns: of clean tables of 60 and 150 rows it was at most 5. Chance makes the largest of
all gains as clear in one of 100,000."""
OTHER_MARKERS = 0.5
"""A single marker moved if some other marker moved by less than this share of its motion."""
CHANGES_TOLD_APART = 6.0
"""Difference of gains, or of Bayesian information criteria, up to which another hypothesis is named too."""
WORTH = 0.97
"""Part of the RMS left-out error that may remain at most with a change or a drift in the model."""
SURE = 3.0
"""Standard deviations from which a fall of squared left-out errors is no chance."""

MIXED_ROWS, TWO_TOOLS_LEFT = 40, 0.45
"""Rows below which tools or payloads of each prove nothing, and the part of the left-out error that may remain with two
tools in turn: noise that is halved by its sign leaves .8."""
PAYLOAD_ODDS, PAYLOADS_LEFT = 12.0, 0.75
"""Log odds of other payloads, beyond those by chance where every row may have any, and the part of the left-out error
that may remain with them."""
ROW_ODDS = 6.0
"""Log odds of a number that differs from row to row: clean images have less than zero, focal lengths that differ by
0.1 % fourteen and more."""

# --- rows of a campaign, one by one ---

WRONG_ROW_CHANCE, UNDONE_CHANCE = 1e-8, 1e-3
"""That a right row counts as wrong, and the same once its mistake is undone."""
JUMP_CHANCE, LEFT_CHANCE = 1e-6, 1e-3
"""Of a named change, and of the errors that it leaves: a campaign of 100 rows asks for about 10,000 changes, most of
them much alike."""
ROWS_AFTER_CHANGE, WINDOW, SPARE_NUMBERS = 2, 12, 3
"""Fewest rows after a change, last rows among which it is sought, numbers beyond its unknowns that must show it."""
TYPICAL_ROWS, TYPICAL_SHARE, FEWEST_TYPICAL, TYPICAL_AT_FIRST = 30, 0.8, 8, 2.0
"""Last accepted rows whose squares, at this share of them, say how large right ones are relative to chance; with fewer
it is the last number: a model of few rows is overconfident."""

# --- lengths, and usual errors of a robot ---

USUAL_SCALES = {"translation_errors": 5e-4, "rotation_errors": 5e-4, "coupled_amplitude": 3e-4, "task_amplitude": 1e-4}
"""Of the errors of links and the amplitudes of the fields, m and rad; what these explain beyond is not the robot's."""
USUAL_SLIDE = 1e-3
"""Of the errors of a slide along its stroke, m."""
USUAL_RATIO, TAKEN_UP = 1e-3, 0.5
"""Relative error of a slide's scale, and of what a joint is to another one that it follows; from the second on the fit
does not take it up."""
LINK_M = 0.05
"""Length of a link from which it is judged by itself."""
LENGTH_CHANCE = 1e-3
"""Of any length that is as wrong."""

# --- changes between two dates ---

OFFSETS_TOLD_APART = 4.0
"""Difference of likelihood ratios up to which the rows do not tell two offsets apart."""
HIDDEN_SHARE = 0.3
"""Displacement by an offset that places do not reproduce, relative to the noise, up to which rows do not show it."""
DRIFT_ODDS = 4.0
"""Log odds of small changes of everything: what chance exceeds in one of twenty."""

# --- wrong rows ---

OUTLIER_CHANCE = 0.01
"""Of any outlier among clean rows."""
UNCHOSEN_FACTOR = 9.0
"""Least size of squared errors where the rows are too few to choose scales: defaults may be overconfident."""
MEDIAN_EFFICIENCY = 0.5
"""Of the median of squared errors, in place of their mean, as an estimate of their variance: .37, .53 and .58 of one,
three and six numbers."""
REMAINING_ERROR = 0.2
"""Largest part of a row's error that may remain with an explanation that is named."""
REMAINING_UNDER_LABEL, LABEL_ROWS, MOST_MASSES = 0.3, 2, 10
"""The same under another label, such as a session; rows that must fit it; payloads up to which each is a label."""
OVERCONFIDENT = 3.0
"""Factor by which an error must exceed what the model's deviations exclude, outside of the rows of its fit."""
BLOCK_SHARE, BLOCK_ROWS, BLOCK_CHANCE = 0.9, 4, 1e-3
"""Share of wrong rows in a block, fewest of them, and the chance that rows spread at random look like one."""
GROSS_SHARE = 0.4
"""Largest share of outliers, of all rows or of one device."""
STUCK_ROWS = 6
"""Rows of a device from which one value in all of them says something."""

# --- rows out of step with their joints ---

LARGEST_LAG = 5
"""Lines between measured values and their joints."""
LAG_CHANGE_COST, LAG_MISFIT = 3.0, 0.1
"""Of a change of the lag, in rows that fit at the new one alone; and of a row of a run that does not fit there."""
LAG_NEAR, LAG_GROSS = 3.0, 10.0
"""Typical distances within which a lag fits, and from which the row's own joints do not."""
LAG_ROWS, LAG_SHARE = 3, 0.8
"""Rows that fit at a lag and not their own joints, and the smallest share of a run that fits."""
WINDOW_PARTS, WINDOW_ROWS, WINDOW_LAGS = (2, 3, 4), 10, (0, -1, 1, -2, 2)
"""Windows of equal length that are registered where the table as a whole fits nowhere, their fewest rows, and lags."""

# --- other readings of a table ---

OTHER_READING_LEFT = 0.2
"""Largest part of the residual that may remain with another reading."""
RIGHT_READING = 0.03
"""Its largest relative residual; right readings leave 0.001 to 0.01, and one of two mistakes undone 0.1."""
DECISIVE_READING = 0.02
"""Part of the residual below which no other mistake is tried."""
REGISTERED_ROWS = 60
"""Largest number of rows that are registered for a reading."""
MOST_MARKERS, MARKER_ROWS, MARKERS_LEFT = 12, 4, 0.5
"""Most texts of a column that are names of markers, fewest rows of each, and the largest part of the RMS error that a
marker for each may leave, of that with one marker and of that with a place of the device for each."""
JOINT_BELOW_TIP = 0.8
"""Part of the residual that a joint below the tip must leave to be warned about; a joint that does not move the markers
leaves more than all of it."""
READINGS_TOLD_APART = 3.0
"""Residual, as a multiple of the best one, from which a reading of rotations counts as worse. The best residual is the
robot's own error e; a wrong reading adds its w to it, sqrt(e^2 + w^2)."""

# --- measurements that no robot explains ---

NEVER_MOVED_M = 1e-6
"""Spread of the markers below which they stand still: no device of robots repeats so well."""
REGISTERED_RESIDUAL, GEOMETRIC_RESIDUAL, UNEXPLAINED_RESIDUAL = 0.25, 0.02, 0.05
"""Relative residual after registration, and after the geometric calibration, from which other readings are tried; a
UR10 leaves 0.001, a wrong tip link 0.1. The same, from which it is warned about without another reading; noise of 1 %
of the reach leaves 0.03."""
FIXED_RANGE, SMALL_RANGE = 1e-3, 0.05
"""Range of a joint, rad or strokes of at most 1 m, below which it never moved, and below which it hardly moved."""
ORIENTATION_RAD, ORIENTATION_SHARE = 0.1, 0.1
"""Largest plausible orientation error after the geometric calibration, and the share of poses that may exceed it."""
LIMIT_EXCESS = 0.25
"""Part of a joint's range by which its values may exceed its limits; robot files are often careless."""
EXACT_SHARE, NOMINAL_SHARE, NOMINAL_RATIO = 1e-6, 1e-4, 1.15
"""Residual after registration, in the extent of the values, that no device leaves, and from which errors of a robot
show; and in that of the geometric calibration, up to which errors of links explain nothing."""
NOMINAL_OVERDETERMINED, NOMINAL_JOINTS = 3.0, 3
"""Coordinates per unknown from which residuals tell something; joints of robots whose errors places do not absorb."""
FOLLOWED, DIGITS_SHARE = 0.1, 1e-5
"""Residual of a marker, in that of another one on the same link, and in the spread of the values, below which it is a
computed place: digits of files leave as much, devices and robots more."""
LARGE_PER_REACH, LARGE_PER_USUAL, MOST_LARGE = 0.01, 20.0, 0.25
"""Errors above this share of the robot's reach, and this multiple of those of usual rows after a geometric calibration,
are no errors of a calibrated robot; share of the rows from which they fail a fit."""
LARGE_PER_EXPECTED = 2.0
"""RMS errors from this multiple of the expected ones on are warned about."""
LARGEST_PER_REACH, LARGEST_PER_EXPECTED = 0.1, 20.0
"""Median errors above this share of the robot's reach, or this multiple of the expected ones, are implausible."""
LEAST_EXPLAINED, AS_GOOD = 0.5, 0.02
"""Part of the squared error, per degree of freedom, that a motion of device or markers must explain; motions that
explain so little less than the best one are named, too."""
LEAST_EXCESS, MOST_LEFT = 2.0, 5.0
"""Multiple of the expected errors below which a motion is not sought, and up to which errors may remain beside one: a
wrong unit is no motion."""

# --- what a campaign leaves open ---

PATH_POSES = 6
"""Poses from which the shape of a path says something."""
FLAT, LEAVES = 0.02, 0.1
"""RMS distance from a plane, a line or a point, below which markers lie on it; speed with which a joint leaves it."""
MOVED_RAD_M, SINGLE_SHARE, SINGLE_JOINTS = 0.05, 0.9, 3
"""Distance from its median from which a joint has moved; share of rows in which at most one has, and fewest joints that
must have, to say that they moved one at a time."""
SAMPLES, SAMPLED_RAD_M, SEEN = 200, 3.2, 0.05
"""Poses that show what the robot could determine, their largest joint value; RMS motion of the markers by a direction's
unit step from which some poses determine it."""
DIGITS, DIGIT_REMAINDER, DIGIT_VALUES, DIGIT_ROWS = 5, 1e-3, 8, 20
"""Of rounded joint values: most digits, largest distance from a multiple of the last one, different multiples; fewer
rows leave errors as large as those of rounding, whatever the digits."""
ROUNDING_LEAST, ROUNDING_MOST = 0.5, 1.5
"""Part of the remaining error from which rounding is reported, and beyond which it cannot have happened: the values
were commanded with few digits, and reached."""

# --- balls, in sockets or by readings ---

READING_ROWS = 40
"""Below which single numbers say too little: a robot of six joints has some thirty geometric errors."""
UNSEEN = 0.05
"""Motion of a reading, relative to that of a coordinate of the ball, below which it does not show a joint."""
TILTED = 0.05
"""Motion by turns of the tool, per unit of the ball's offset, below which its place along a direction is open."""
SIZE_SHARE = 0.8
"""Share of the expected error from which the robot's size is warned about."""
SOCKET_SURPLUS = 6
"""Rows in sockets beyond the number of these."""
SOCKET_FAR = 0.02
"""Median distance of the ball from its socket that is doubted, as a part of the robot's reach."""
DISTANCE_SHARE, DISTANCE_MEDIANS = 0.1, 5.0
"""Relative error of a known distance that is doubted, if it also exceeds so many median distances of the ball from its
socket; and its largest relative error in the right unit."""
WRONG_SOCKET_MEDIANS, OTHER_SOCKET_FITS, WRONG_SOCKETS = 8.0, 0.3, 0.25
"""Distance from its socket, in medians, from which a row may be in a wrong one; relative distance from another one
below which it is; share of such rows that is refused."""
OTHER_ROBOT_RESIDUALS, OTHER_ROBOT_SHARE, OVERDETERMINED = 2.5, 1e-3, 2.0
"""Spread within sockets, in median residuals of measured positions, and in reaches of the robot, above both of which
the rows are not those of one robot; coordinates per unknown of base and markers from which residuals are compared."""
RAISED, WORTHWHILE_PLACE = 0.2, 0.8
"""Distance of a new place from the plane of the sockets, relative to the largest one from the base; expected error with
it, relative to that without, below which it is advised."""
