"""What a diagnosis decides by. All of it was set on robots that were opened; sealed ones say how well (docs/blind.md)."""

from __future__ import annotations

#: probabilities: below which of the best nothing is fitted, below which a cause is not looked at, above which it is a finding
DOUBT, SUSPECT, FINDING = 0.12, 0.07, 0.5
#: probability from which a cause is believed if it takes away so much of what is strange that this share is left
MAYBE, EASES = 0.2, 0.7
#: probability of a cause that little closure on the held-out runs does not overrule: a stop, say, shows in few of them
CERTAIN = 0.8
#: probability of a second cause, once the first is taken into account
SECOND = 0.35
#: nothing is surer
SURELY = 0.99
#: share of its least size below which a cause that was re-fitted on the runs has vanished
VANISHED = 0.1
#: how many causes are looked at, at most and at least; and at least where the log is strange and no cause likely
SUSPECTS, LIKELIEST, PUZZLED = 5, 3, 7
#: how many causes are looked at of what the judge sees beside the first; how many of those it expects are tried, and of others
OTHERS, TOLD, MORE = 4, 2, 2
#: how many of the likeliest are fitted on the runs whatever they leave; times the least cost beyond which others are not
LIKELIEST_FITTED, FAR_WORSE = 2, 4.0
#: share of what is left without any cause that a first look leaves with one which contacts are fitted beside
CLEARLY = 0.75
#: held-out closure that an addition must bring; that one cause must bring beyond what tolerances do, where the judge doubts;
#: and below which a set explains nothing
ADDS, ADDS_ALONE, EXPLAINS = 0.02, 0.2, 0.35
#: that one cause must bring beyond what tolerances do where those leave as little as of a healthy robot
BARELY = 0.05
#: beyond which what closes is no riddle, however odd what is left may be
CLOSES_MOST = 0.75
#: and that a second cause must bring which the judge does not expect
ADDS_MUCH = 0.15
#: share of what a re-fit leaves that a cause leaves of it where closure alone proves it
PROVES = 0.72
#: share of what a re-fit leaves that is little enough: no rival is looked for where the best cause leaves no more
SETTLED = 0.35
#: gaps that are so many floors, of robots whose energy is so many gates, ask for an explanation; beyond ODD gates no robot of
#: the build is healthy, whatever the judge says
LARGE, STRANGE, ODD = 3.0, 3.0, 20.0
#: energy beyond which what a set leaves is a riddle, and held-out closure below which it then has not explained the gap
RIDDLE, EXPLAINS_RIDDLE = 10.0, 0.55
#: share of what is strange, left where windows put a cause, that it leaves where features put it: there it stays
FAR_LESS = 0.5
#: share of a scatter that comes back at the same angles beyond which nothing random makes it
RETURNS = 0.15
#: share of what is strange that a cause leaves which has no part in it
STAYS = 0.95
#: floors that a re-fit of a healthy robot does not leave; and that make a riddle of whatever is strange
STRAYS, ASTRAY = 4.0, 10.0
#: times what a re-fit leaves of a servo's other joints that it leaves of a joint where alone suspects are compared
STANDS_OUT = 2.0
#: sets whose closures differ by less are not told apart; effects in a set that is not told from others, at most
APART, TOGETHER = 0.01, 3
#: how what is left of the gap counts beside the judge's probability
LEFT_COUNTS = 8.0
#: °C between runs from which heat is asked about, and its cause
WARMED_C, HEAT = 2.5, "thermal_derating"
#: 1/°C of torque that any motor loses: copper's resistance grows by 0.4 %, and its magnets weaken; twice that is an effect
COPPER = 0.01
#: robots of no more joints are cheap to simulate: all suspects are fitted together
FEW_JOINTS = 2
#: s after it has begun from which a diagnosis looks for no causes that the judge does not expect: slow computers have to answer,
#: too; and how many of them may be over when the judge speaks, since what is prepared for later diagnoses is no part of this one
PATIENCE_S, BEFOREHAND_S = 75.0, 30.0
#: shares of that by which what takes long has to be begun, and what only makes the model better
EARLY, LATE = 0.65, 1.2
