"""The gates of every diagnosis: from where something is doubted, warned about, refused or named.

A relative residual is a median distance divided by the spread of the markers; lengths of a campaign are relative to the
largest distance of the tip from the base. A chance is the probability that right rows show as much.
"""

from __future__ import annotations

JUDGED_COORDINATES = 2000  # of the random rows that stand for all where there are more

# --- what changed during the measurements ---

CHANGE_ROWS = 5  # fewest rows on either side of a change
# Gain less the price of its unknowns: of clean tables of 60 and 150 rows it was at most 5. Chance makes the largest of
# all gains as clear in one of 100,000.
CHANGE_EVIDENCE = 24.0
CHANGES_TOLD_APART = 6.0  # difference of gains, or of information criteria, up to which a hypothesis is named too
WORTH = 0.97  # part of the RMS left-out error that may remain at most with a change or a drift in the model
SURE = 3.0  # standard deviations from which a fall of squared left-out errors is no chance
# Rows below which tools or payloads of each prove nothing, and the part of the left-out error that may remain with two
# tools in turn: noise that is halved by its sign leaves .8.
MIXED_ROWS, TWO_TOOLS_LEFT = 40, 0.45
# Log odds of other payloads, beyond those by chance where every row may have any, and the part of the left-out error
# that may remain with them.
PAYLOAD_ODDS, PAYLOADS_LEFT = 12.0, 0.75
# Log odds of a number that differs from row to row: clean images have less than zero, focal lengths that differ by
# 0.1 % fourteen and more.
ROW_ODDS = 6.0

# --- rows of a campaign, one by one ---

WRONG_ROW_CHANCE, UNDONE_CHANCE = 1e-8, 1e-3  # that a right row counts as wrong; the same once its mistake is undone
# Of a named change, and of the errors that it leaves: a campaign of 100 rows asks for about 10,000 changes, most of
# them much alike.
JUMP_CHANCE, LEFT_CHANCE = 1e-6, 1e-3
# Fewest rows after a change, last rows among which it is sought, numbers beyond its unknowns that must show it.
ROWS_AFTER_CHANGE, WINDOW, SPARE_NUMBERS = 2, 12, 3
# Last accepted rows whose squares, at this share of them, say how large right ones are relative to chance; with fewer
# it is the last number: a model of few rows is overconfident.
TYPICAL_ROWS, TYPICAL_SHARE, FEWEST_TYPICAL, TYPICAL_AT_FIRST = 30, 0.8, 8, 2.0

# --- lengths, and usual errors of a robot ---

# Of the errors of links and the amplitudes of the fields, m and rad; what these explain beyond is not the robot's.
USUAL_SCALES = {"translation_errors": 5e-4, "rotation_errors": 5e-4, "coupled_amplitude": 3e-4, "task_amplitude": 1e-4}
USUAL_SLIDE = 1e-3  # of the errors of a slide along its stroke, m
# Relative error of a slide's scale, and of what a joint is to another one that it follows; from the second on the fit
# does not take it up.
USUAL_RATIO, TAKEN_UP = 1e-3, 0.5
LINK_M, LENGTH_CHANCE = 0.05, 1e-3  # length of a link that is judged by itself; chance of any length that is as wrong

# --- changes between two dates ---

OFFSETS_TOLD_APART = 4.0  # difference of likelihood ratios up to which the rows do not tell two offsets apart
# Displacement by an offset that places do not reproduce, relative to the noise, up to which rows do not show it.
HIDDEN_SHARE = 0.3
DRIFT_ODDS = 4.0  # log odds of small changes of everything: what chance exceeds in one of twenty

# --- wrong rows ---

OUTLIER_CHANCE = 0.01  # of any outlier among clean rows
# Least size of squared errors where the rows are too few to choose scales: defaults may be overconfident.
UNCHOSEN_FACTOR = 9.0
# Of the median of squared errors, in place of their mean, as an estimate of their variance: .37, .53 and .58 of one,
# three and six numbers.
MEDIAN_EFFICIENCY = 0.5
REMAINING_ERROR = 0.2  # largest part of a row's error that may remain with an explanation that is named
MOST_MASSES = 10  # payloads up to which each is a label
# Factor by which an error must exceed what the model's deviations exclude, outside of the rows of its fit.
OVERCONFIDENT = 3.0
# Share of wrong rows in a block, fewest of them, and the chance that rows spread at random look like one.
BLOCK_SHARE, BLOCK_ROWS, BLOCK_CHANCE = 0.9, 4, 1e-3
GROSS_SHARE = 0.4  # largest share of outliers, of all rows or of one device
STUCK_ROWS = 6  # rows of a device from which one value in all of them says something

# --- rows out of step with their joints ---

LARGEST_LAG = 5  # lines between measured values and their joints
# Of a change of the lag, in rows that fit at the new one alone; and of a row of a run that does not fit there.
LAG_CHANGE_COST, LAG_MISFIT = 3.0, 0.1
LAG_NEAR, LAG_GROSS = 3.0, 10.0  # typical distances within which a lag fits, and from which own joints do not
LAG_ROWS, LAG_SHARE = 3, 0.8  # rows that fit at a lag and not their own joints; smallest share of a run that fits
# Windows of equal length that are registered where the table as a whole fits nowhere, their fewest rows, and lags.
WINDOW_PARTS, WINDOW_ROWS, WINDOW_LAGS = (2, 3, 4), 10, (0, -1, 1, -2, 2)

# --- other readings of a table ---

OTHER_READING_LEFT = 0.2  # largest part of the residual that may remain with another reading
# Its largest relative residual; right readings leave 0.001 to 0.01, and one of two mistakes undone 0.1.
RIGHT_READING = 0.03
DECISIVE_READING = 0.02  # part of the residual below which no other mistake is tried
REGISTERED_ROWS = 60  # largest number of rows that are registered for a reading
# Most texts of a column that are names of markers, fewest rows of each, and the largest part of the RMS error that a
# marker for each may leave, of that with one marker and of that with a place of the device for each.
MOST_MARKERS, MARKER_ROWS, MARKERS_LEFT = 12, 4, 0.5
# Part of the residual that a joint below the tip must leave to be warned about; a joint that does not move the markers
# leaves more than all of it.
JOINT_BELOW_TIP = 0.8
# Residual, as a multiple of the best one, from which a reading of rotations counts as worse. The best residual is the
# robot's own error e; a wrong reading adds its w to it, sqrt(e^2 + w^2).
READINGS_TOLD_APART = 3.0

# --- measurements that no robot explains ---

NEVER_MOVED_M = 1e-6  # spread of the markers below which they stand still: no device of robots repeats so well
# Relative residual after registration, and after the geometric calibration, from which other readings are tried; a
# UR10 leaves 0.001, a wrong tip link 0.1. The same, from which it is warned about without another reading; noise of 1 %
# of the reach leaves 0.03.
REGISTERED_RESIDUAL, GEOMETRIC_RESIDUAL, UNEXPLAINED_RESIDUAL = 0.25, 0.02, 0.05
FIXED_RANGE, SMALL_RANGE = 1e-3, 0.05  # range, rad or strokes of at most 1 m, of a joint that never, or hardly, moved
# Largest plausible orientation error after the geometric calibration, and the share of poses that may exceed it.
ORIENTATION_RAD, ORIENTATION_SHARE = 0.1, 0.1
LIMIT_EXCESS = 0.25  # part of a joint's range by which its values may exceed its limits; robot files are careless
# Residual after registration, in the extent of the values, that no device leaves, and from which errors of a robot
# show; and in that of the geometric calibration, up to which errors of links explain nothing.
EXACT_SHARE, NOMINAL_SHARE, NOMINAL_RATIO = 1e-6, 1e-4, 1.15
# Coordinates per unknown from which residuals tell something; joints of robots whose errors places do not absorb.
NOMINAL_OVERDETERMINED, NOMINAL_JOINTS = 3.0, 3
# Residual of a marker, in that of another one on the same link, and in the spread of the values, below which it is a
# computed place: digits of files leave as much, devices and robots more.
FOLLOWED, DIGITS_SHARE = 0.1, 1e-5
# Errors above this share of the robot's reach, and this multiple of those of usual rows after a geometric calibration,
# are no errors of a calibrated robot; share of the rows from which they fail a fit.
LARGE_PER_REACH, LARGE_PER_USUAL, MOST_LARGE = 0.01, 20.0, 0.25
LARGE_PER_EXPECTED = 2.0  # RMS errors from this multiple of the expected ones on are warned about
# Median errors above this share of the robot's reach, or this multiple of the expected ones, are implausible.
LARGEST_PER_REACH, LARGEST_PER_EXPECTED = 0.1, 20.0
# Part of the squared error, per degree of freedom, that a motion of device or markers must explain; motions that
# explain so little less than the best one are named, too.
LEAST_EXPLAINED, AS_GOOD = 0.5, 0.02
# Multiple of the expected errors below which a motion is not sought, and up to which errors may remain beside one: a
# wrong unit is no motion.
LEAST_EXCESS, MOST_LEFT = 2.0, 5.0

# --- what a campaign leaves open ---

PATH_POSES = 6  # from which the shape of a path says something
# RMS distance from a plane, a line or a point, below which markers lie on it; speed with which a joint leaves it.
FLAT, LEAVES = 0.02, 0.1
# Distance from its median from which a joint has moved; share of rows in which at most one has, and fewest joints that
# must have, to say that they moved one at a time.
MOVED_RAD_M, SINGLE_SHARE, SINGLE_JOINTS = 0.05, 0.9, 3
# Poses that show what the robot could determine, their largest joint value; RMS motion of the markers by a direction's
# unit step from which some poses determine it.
SAMPLES, SAMPLED_RAD_M, SEEN = 200, 3.2, 0.05
# Of rounded joint values: most digits, largest distance from a multiple of the last one, different multiples; fewer
# rows leave errors as large as those of rounding, whatever the digits.
DIGITS, DIGIT_REMAINDER, DIGIT_VALUES, DIGIT_ROWS = 5, 1e-3, 8, 20
# Part of the remaining error from which rounding is reported, and beyond which it cannot have happened: the values
# were commanded with few digits, and reached.
ROUNDING_LEAST, ROUNDING_MOST = 0.5, 1.5

# --- balls, in sockets or by readings ---

READING_ROWS = 40  # fewer tell too little: a robot of six joints has some thirty geometric errors
UNSEEN = 0.05  # motion of a reading, relative to that of a coordinate of the ball, that does not show a joint
# Motion by turns of the tool, per unit of the ball's offset, below which its place is open anywhere, or one way.
TURNED, TILTED = 0.02, 0.05
SIZE_SHARE = 0.8  # of the expected error from which the robot's size is warned about
SOCKET_SURPLUS = 6  # rows in sockets beyond the number of these
SOCKET_FAR = 0.02  # median distance of the ball from its socket that is doubted, as a part of the robot's reach
# Relative error of a known distance that is doubted, if it also exceeds so many median distances of the ball from its
# socket; and its largest relative error in the right unit.
DISTANCE_SHARE, DISTANCE_MEDIANS = 0.1, 5.0
# Distance from its socket, in medians, from which a row may be in a wrong one; relative distance from another one
# below which it is; share of such rows that is refused.
WRONG_SOCKET_MEDIANS, OTHER_SOCKET_FITS, WRONG_SOCKETS = 8.0, 0.3, 0.25
# Spread within sockets, in median residuals of measured positions, and in reaches of the robot, above both of which
# the rows are not those of one robot; coordinates per unknown of base and markers from which residuals are compared.
OTHER_ROBOT_RESIDUALS, OTHER_ROBOT_SHARE, OVERDETERMINED = 2.5, 1e-3, 2.0
