"""What stands below the figures of a report, by what they show and by which method."""

from __future__ import annotations

CURVE = (
    "Grey: as read; blue: corrected; line: what the fit on the reference says at that amplitude. Z is counted from the "
    "onset, where the amplitude begins to fall. Readings far above the sample show no more than noise once corrected. "
    "Without a sample, everything that is read of a higher harmonic comes from the instrument."
)
SCAN = (
    "Both colour scales of a signal are equally wide, each about its own map. Below: the pixels that tied the scan "
    "to the approach curve, and medians of the lines over these pixels, less the median of all lines."
)
GREY = "Grey with stripes: the data do not determine the value there. Flat light grey: no data."
STEPS = (
    "Colours change in steps, each at least as wide as the typical 90 % interval of one determined pixel, which the "
    "colour bar names; they change where the fewest pixels are. Colours two steps apart are as a rule different "
    "values, neighbouring colours may be one: there are as many colours as the data tell values apart, at least two, "
    "and a continuous scale where an interval is narrower than 2 % of it. Determined pixels set the scale; a pointed "
    "end of the bar says that values lie beyond."
)
ESTIMATES = (
    f"Estimates, the range of moduli that fit the data at 90 %, and what each pixel can be trusted for. {GREY} A "
    "small residual N_r is no evidence that an estimate is right: three force harmonics and three unknowns leave next "
    "to no residual at any answer."
)
SOLUTIONS = (
    "The physical solution of the force harmonics, where there is one; how many there are; how many decades of modulus "
    "lie between them where there are several; what each pixel can be trusted for; and the standard deviation of ln E. "
    f"{GREY} Of the modulus: {STEPS} Its interval is linearised at the solution; the other properties come without "
    "one, and their colours say nothing of how well they are known."
)
INTERVALS = (
    "Each row is one property on one colour scale: the median of its posterior, and the lower and the upper end of its "
    "90 % interval. Where the three look alike the value is known; where they differ it lies between them. A curve "
    f"has its intervals as bars. {GREY} {STEPS} Intervals hold what the whole scan shares too, which moves all pixels "
    "together."
)
CERTAINTY = (
    "How many decades the 90 % interval of the modulus is wide; the standard deviations of ln E from noise, which "
    "more pixels average out, and from what the whole scan shares, which they do not, on one scale; what each pixel "
    "can be trusted for; how probable it is that the tip touches the sample; and where several models were compared, "
    "the one chosen and its probability among them."
)
PHASES = (
    "Phases told apart in the observables, before any contact model; grey pixels belong to none. Shrinkage: 0 "
    "where the data of the pixel alone decide ln E, 1 where its phase does."
)
CHECK = (
    "Mean of each force harmonic of a phase (value at the left) against what the model predicts for it from the "
    "others: bars hold 90 % of the prediction, in its standard deviations. Diamonds lie outside. p: chance of a "
    "larger chi-squared if the model is right."
)
NOWHERE = "No pixel is determined: words stand where a map of colours would look like an answer."
VALIDITY = (
    "What the contact asks of its model: a small pressure against the modulus, a depth small against the tip radius, "
    f"adhesion of the kind that the model has. {GREY}"
)
COUNTS = (
    "Filled: determined pixels; outlined: all others, which are no measurement; both axes are logarithmic."
)
BARS = (
    f"{COUNTS} Bars: from the median lower to the median upper end of the 90 % intervals of the determined pixels; "
    "scatter narrower than its bar is no difference between pixels."
)
