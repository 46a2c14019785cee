"""What each key of a spec means: section -> key -> (unit, meaning, example).  Types and defaults come from the schema.

A test compares the keys with those of the schema: a key that is not explained here fails it.
"""

from __future__ import annotations

#: By class of the schema; `Constant` is a mapping that the plant reads itself.
Keys = dict[str, dict[str, tuple[str, str, str]]]

_SIGNALS = {
    "operating_point": (
        "of the signal",
        "Values of signals at the point where the linear model is valid. They are subtracted from a log and added to "
        "the estimates, so that logs may hold absolute values.",
        "{heater: 60, cell: 80}",
    ),
    "scales": ("unit / unit", "Factor from the unit of a log to the unit of the signal.", "{speed: 0.1047}"),
    "units": (
        "",
        "Unit of each signal, as text: it is printed, and columns of a log that state another one are converted to it.",
        "{cell: degC, heater: W}",
    ),
}
_DELAYS = (
    "s",
    "Dead times of inputs and outputs: seconds, or texts with a unit (us, ms, s, min, h, d). See "
    "[dead time](../howto/dead_time).",
    "{valve: 2.5 s, analyser: 3 min}",
)
_NAMES = {
    f"{kind}_names": ("", f"Names of the {what}, in the order of the {where}.", example)
    for kind, what, where, example in (
        ("state", "states", "columns of A", "[heater, air, wall]"),
        ("input", "known inputs", "columns of B", "[power]"),
        ("output", "outputs", "rows of C", "[T1, T2]"),
        ("fault", "faults", "columns of Bf and Df", "[leak]"),
        ("disturbance", "unknown inputs", "columns of Bd and Dd", "[ambient]"),
        ("noise", "noises", "columns of Bw and Dw", "[w1, w2]"),
        ("parameter", "parameters", "columns of Phi and Psi", "[leak]"),
    )
}
_NOISE = {
    "sensor_noise": (
        "of the output",
        "Standard deviation of the noise of each output, per sample; or coloured noise, see below.",
        "{T1: 0.05, T2: {deviation: 0.4, correlation: 90 s}}",
    ),
    "offset": (
        "of the output",
        "Outputs with a constant offset: its standard deviation, or `unknown` for a calibration to find. "
        "Each becomes a state.",
        "{T1: 0.5}",
    ),
    "walks": (
        "unit / sqrt(s)",
        "Unknown inputs and faults that are random walks: how far they walk in a second (discrete plants: in a sample), "
        "or `unknown`. Each becomes a state.",
        "{ambient: 0.01}",
    ),
}
_TOLERANCES = {
    "constants": (
        "",
        "Named numbers that entries of the matrices (or equations) may use: a number, or one with a `tolerance` "
        "or a `range`, see below.",
        "{k: 0.05, C1: {nominal: 2.0, tolerance: 5 %}}",
    ),
    "variation": (
        "",
        "Whether constants keep one value in their ranges for ever, or may take another one at each sample.",
        "constant",
    ),
    "box": ("", "Where the ranges of the constants come from, see below.", "{file: box.json}"),
    "transform": ("", "What is done to the plant before a method gets it, see below.", "{sample_time: 10}"),
}

KEYS: Keys = {
    "SpecDocument": {
        "schema_version": ("", "Version of this document: 1.", "1"),
        "name": (
            "",
            "Name of the design and of its files: letters, digits, `.`, `_` and `-`, at most 100.",
            "oven",
        ),
        "description": ("", "A text for readers.", "Heater, air and wall"),
        "plant": ("", "The plant: matrices, equations, or a file with them, see below.", "{file: plant.yaml}"),
        "method": ("", "The method and its options, see below. Without it, `auto` chooses.", "{id: pd-observer}"),
        "scenario": ("", "What happens in simulations and what monitors expect, see below.", "{horizon: 60}"),
        "inputs": ("", "When the inputs of a row of a log act, see below.", "{hold: ends}"),
        "calibrate": ("", "The log, and what `obsynth calibrate` finds in it, see below.", "{log: normal.csv}"),
    },
    "PlantSection": {
        "dt": ("s", "Sampling time; 0 for a plant in continuous time.", "0.1"),
        "E": ("", "nx by nx; may be singular. Left out: the identity.", "[[1, 0], [0, 0]]"),
        "A": ("", "nx by nx.", "[[-0.5, 1], [1, 1]]"),
        "B": ("", "Known inputs, nx by nu.", "[[1], [0]]"),
        "C": ("", "Outputs, ny by nx; or the states that are measured.", "{outputs: [cell, plate]}"),
        "D": ("", "Direct effect of known inputs on outputs, ny by nu.", "[[0], [0.1]]"),
        "Bf": (
            "",
            "Faults in the equations, nx by nf; or the equations, by the names of their states.",
            "{states: [v1]}",
        ),
        "Df": (
            "",
            "Faults of sensors, ny by nf; or the outputs, each of which gets a fault of its own.",
            "{outputs: [v3]}",
        ),
        "Bd": ("", "Unknown inputs in the equations, nx by nd; or by name, as Bf.", "[[0], [1]]"),
        "Dd": ("", "Unknown inputs on the outputs, ny by nd; or by name, as Df.", "{outputs: [v3]}"),
        "Bw": (
            "unit / sqrt(s), or per sample",
            "White noise of unit intensity in the equations, nx by nw: entries are standard deviations.",
            "[[0.01], [0]]",
        ),
        "Dw": (
            "of the outputs, per sample",
            "White noise on the outputs, ny by nw: entries are standard deviations. `sensor_noise` adds a column for "
            "each sensor; write Dw where the noise of several sensors is correlated, or acts on equations as well.",
            "[[0.1, 0], [0, 0.2]]",
        ),
        **{name: text for name, text in _NAMES.items() if name != "parameter_names"},
        **_SIGNALS,
        "delays": _DELAYS,
        "functionals": (
            "",
            "Combinations of states with names of their own: further states, which every command shows, and which "
            "`states` of `functional-filter` estimates alone, by an observer of low order. Their units go into `units`.",
            "{twist: {motor: 1, load: -1}}",
        ),
        **_NOISE,
        **_TOLERANCES,
        "scheduling": (
            "",
            "Measured parameters that the matrices depend on: the design then holds over their whole region, see below.",
            "{v: {range: [-1, 1], column: speed}}",
        ),
        "entries": (
            "",
            "Entries that are expressions in `constants`, where matrices come from files: by matrix a list, see below. "
            "In matrices that are written out, write the expression in its place.",
            "{A: [{row: wall, column: air, value: k/C1}]}",
        ),
        "tolerance": ("%", "The same relative tolerance for every entry of a matrix that is not zero.", "{A: 2 %}"),
    },
    "PlantReference": {
        "file": (
            "",
            "A plant in a file: YAML as here, or `.mat`. The other keys but `transform` are for `.mat`.",
            "plant.mat",
        ),
        "transform": ("", "Replaces the transform in the file.", "{sample_time: 0.02}"),
        "variable": ("", "Struct in the file.", "sys"),
        "dt": ("s", "Sampling time, where the file does not state it.", "0.1"),
        "faults": ("", "Inputs of the model that are faults.", "[u2]"),
        "disturbances": ("", "Inputs of the model that are not known.", "[load]"),
        "actuator_faults": ("", "Known inputs to which a fault is added.", "[u1]"),
        "sensor_faults": ("", "Outputs to which a bias is added.", "[y1]"),
        "sensor_noise": ("of the output", "Standard deviation of the noise of each output, per sample.", "{y1: 0.1}"),
        **_SIGNALS,
        "delays": _DELAYS,
    },
    "TimeVaryingSection": {
        "kind": ("", "Says that matrices change with k.", "time-varying"),
        "dt": ("s", "Sampling time.", "1"),
        "horizon": (
            "samples",
            "Number of steps for which the matrices are given. Left out: expressions hold for ever.",
            "500",
        ),
        "constants": ("", "Names and values that expressions may use besides `k`.", "{w: 0.2}"),
        "E": (
            "",
            "ne by nx, needed at k = 1, ..., N; may be singular or rectangular. Left out: the identity.",
            "[[1, 0], [0, 0]]",
        ),
        "A": ("", "ne by nx, needed at k = 0, ..., N - 1, as B, Phi and Psi.", '[[0.9, "0.1*sin(w*k)"], [0.5, -1]]'),
        "B": ("", "Known inputs, ne by nu.", "[[1], [0]]"),
        "C": ("", "Outputs, ny by nx, needed at k = 1, ..., N.", "[[1, 0]]"),
        "Phi": ("", "Parameters (faults) in the equations, ne by nq.", '[["1 + 0.5*cos(0.1*k)"], [0.1]]'),
        "Psi": ("", "Parameters (faults) on the outputs, ny by nq.", "[[1]]"),
        "D": ("", "Known inputs on the outputs, ny by nu; needed from k = 1 on.", "[[1]]"),
        **{name: _NAMES[name] for name in ("state_names", "input_names", "output_names", "parameter_names")},
        **_SIGNALS,
    },
    "DAESection": {
        "kind": ("", "Says that the plant is given by equations.", "dae"),
        "equations": (
            "",
            "By name, as many as states; `der(...)` is a time derivative, `where(a > b, c, d)` a choice.",
            '{balance: "area*der(level) = inflow - c*sqrt(level)"}',
        ),
        "outputs": ("", "By name, what each sensor measures.", "{gauge: level}"),
        "states": ("of the state", "Nominal values: start, and size, of each state.", "{level: 1.0}"),
        "inputs": ("of the input", "Known inputs with their usual values: columns of the log.", "{inflow: 0.1}"),
        "parameters": (
            "of the parameter",
            "What is estimated, with nominal values: a fault is a change of one.",
            "{c: 0.1}",
        ),
        "definitions": (
            "",
            "Names for expressions that equations, outputs and later definitions may use.",
            '{q: "c*sqrt(level)"}',
        ),
        "process_noise": (
            "of the equation * sqrt(s)",
            "Intensity of white noise in each equation, for its linearisation.",
            "{balance: 0.01}",
        ),
        **_NOISE,
        **_TOLERANCES,
        "units": _SIGNALS["units"],
    },
    "TransformSection": {
        "linearise": ("", "Where equations are linearised, see below.", "{given: {level: 4.0}}"),
        "eliminate_algebraic_states": ("", "Solve the algebraic equations first; needs index 1.", "true"),
        "pade": (
            "",
            "Replace the delays of a continuous plant by Pade approximations of this order; claims are then for that model.",
            "3",
        ),
        "sample_time": ("s", "Sample the plant with a zero-order hold; exact for delays of any length.", "10"),
    },
    "LineariseSection": {
        "at": ("", "Linearise where nothing moves, or at the point that `given` states.", "equilibrium"),
        "given": ("of the signal", "Known values of states, inputs, parameters and outputs there.", "{level: 4.0}"),
        "free": (
            "",
            "Inputs and parameters that are solved for, with bounds where they have some.",
            "{inflow: [0, 2]}",
        ),
        "faults": ("", "Parameters that are faults. Left out: all.", "[c]"),
        "disturbances": ("", "Inputs that are not known.", "[rain]"),
        "start": ("of the state", "Where the search for the equilibrium begins.", "{level: 1.0}"),
        "drift": ("", "Accept a point that moves: its motion becomes an input `drift`, which is 1.", "true"),
        "constants": (
            "",
            "Tolerances of constants and parameters, as `constants` of a plant.",
            "{area: {tolerance: 2 %}}",
        ),
    },
    "Constant": {
        "nominal": ("of the constant", "Its value. Left out: for a range, the middle.", "2.0"),
        "tolerance": ("%, or a share", "Half of the width of its range, relative to the nominal value.", "5 %"),
        "range": ("of the constant", "Its range, in place of a tolerance; it need not be symmetric.", "[1.9, 2.2]"),
        "unit": ("", "Its unit, as text.", "kJ/K"),
    },
    "SchedulingSection": {
        "range": ("of the parameter", "Its least and its largest value.", "[-1, 1]"),
        "rate": ("of the parameter / s", "Its largest change in a second. Left out: it may jump.", "0.02"),
        "column": ("", "Its column in a log. Left out: the column with its name.", "speed"),
        "unit": ("", "Its unit, as text.", "m/s"),
        "measured": ("", "Must be true: a parameter that is not measured cannot schedule a gain.", "true"),
    },
    "EntrySection": {
        "row": ("", "Row, by name or by number from 1.", "wall"),
        "column": ("", "Column, by name or by number from 1.", "air"),
        "value": ("", "Expression in the constants; a power is written `**`.", "k / C1"),
    },
    "BoxSection": {
        "source": ("", "How the ranges were obtained.", "calibrated"),
        "level": ("", "Probability with which a calibrated box holds the constants.", "0.95"),
        "digest": ("", "SHA-256 of the calibration or of the log.", "9f86d081..."),
        "file": ("", "What `obsynth calibrate --out` wrote.", "box.json"),
    },
    "ColouredNoise": {
        "deviation": ("of the output", "Standard deviation, or `unknown` for a calibration to find.", "0.4"),
        "correlation": ("s", "Correlation time; a text may have a unit.", "90 s"),
        "white": ("of the output", "Standard deviation of white noise beside it. Left out: a hundredth.", "0.02"),
    },
    "MethodSection": {
        "id": ("", "One of the methods below, or `auto`.", "ui-pi-observer"),
        "options": ("", "Options of the method, see below.", "{decay: 0.01}"),
    },
    "ScenarioSection": {
        "horizon": ("s", "Length.", "60"),
        "sample_time": ("s", "Time between samples of a continuous plant. A discrete one has its own.", "0.1"),
        "inputs": (
            "",
            "Profile, or list of profiles, of each known input. Left out: zero.",
            "{power: {kind: step, size: 5}}",
        ),
        "faults": ("", "The same of each fault.", "{leak: {kind: step, size: 0.1, start: 20}}"),
        "disturbances": (
            "",
            "The same of each unknown input.",
            "{ambient: {kind: sine, amplitude: 1, frequency: 0.1}}",
        ),
        "sensors": (
            "",
            "What is wrong with a sensor, by output; the model of the plant does not know of it.",
            "{T1: {kind: stuck, start: 30}}",
        ),
        "noise": ("", "The plant's own noise as a multiple of what it states; 0 for none.", "1"),
        "sensor_noise": ("of the output", "Standard deviation of more white noise, per sample.", "{T1: 0.02}"),
        "seed": ("", "Seed of the random numbers.", "1"),
        "initial_state": ("of the state", "States at the start; those that are not named are zero.", "{wall: 2.0}"),
        "observer_state": (
            "",
            "State of the observer at the start, one number for each. Left out: zero.",
            "[0, 0, 0, 0]",
        ),
        "stabilise": (
            "",
            "Add a state feedback that stabilises the plant, in the simulation only (linear-quadratic, unit weights).",
            "true",
        ),
        "scheduling": (
            "profiles by parameter",
            "How the scheduling parameters of a plant over a region move: added to the middle of their ranges.",
            "{speed: {kind: sine, amplitude: 1, frequency: 0.1}}",
        ),
    },
    "ProfileSection": {
        "kind": ("", "How the signal goes with time.", "step"),
        "start": ("s", "When it begins. Left out: 0.", "20"),
        "end": ("s", "When it ends. Left out: never.", "40"),
        "size": ("of the signal", "`step`, `drift`, `intermittent`: the value.", "0.1"),
        "rate": ("unit / s", "`ramp`: the slope.", "0.01"),
        "amplitude": ("of the signal", "`sine`.", "1.0"),
        "frequency": ("rad/s", "`sine`.", "0.5"),
        "phase": ("rad", "`sine`. Left out: 0.", "1.57"),
        "time_constant": ("s", "`drift`: time constant with which it approaches `size`.", "30"),
        "period": ("s", "`intermittent`: time from one beginning to the next.", "5"),
        "duty": ("", "`intermittent`: share of the period in which it acts.", "0.5"),
        "times": ("s", "`time-table`: increasing times of its points.", "[0, 10, 20]"),
        "values": ("of the signal", "`time-table`: the values there; the last one stays.", "[0, 1.5, 1]"),
        "interpolation": (
            "",
            "`time-table`: straight lines between the points, or each value until the next time. Left out: `linear`.",
            "held",
        ),
        "value": ("of the signal", "`stuck`: where it stays. Left out: where it is at `start`.", "0"),
        "share": ("", "`lost-effectiveness`: share of the signal that is lost.", "0.3"),
        "low": ("of the signal", "`uniform`: lower limit.", "-0.1"),
        "high": ("of the signal", "`uniform`: upper limit.", "0.1"),
        "deviation": ("of the signal", "`gaussian`: standard deviation.", "0.05"),
        "mean": ("of the signal", "`gaussian`: mean. Left out: 0.", "0"),
    },
    "InputsSection": {
        "hold": (
            "",
            "Whether the inputs of a row act during the step that begins or that ends there. Left out: `begins` for "
            "linear and time-varying plants, `ends` for equations.",
            "ends",
        ),
        "delay": ("rows", "By how many more rows they act later; negative: earlier.", "1"),
    },
    "CalibrateSection": {
        "log": ("", "The log, a file beside the spec.", "normal.csv"),
        "rows": ("", "Rows without faults: from, to (not included), counted from 0. Left out: all.", '"0:56"'),
        "columns": ("", "Column of each signal, or of `time`, where the names differ.", "{time: Zeit}"),
        "scales": ("unit / unit", "Factor from the unit of the column to that of the signal.", "{level: 0.01}"),
        "dt": ("s", "Time between rows. Left out: the median of the stamps.", "5"),
        "unknown": ("", "Constants and parameters to find, each with its bounds.", "{a1: [0.005, 0.08]}"),
        "priors": (
            "",
            "What is known of an unknown constant besides: mean and standard deviation of a normal distribution.",
            "{a1: [0.02, 0.005]}",
        ),
        "noisy": ("", "Equations that noise drives. Left out: all.", "[balance]"),
        "Q": ("(unit of the equation)^2", "Variances of that noise that are known, per step.", "{balance: 1.0e-4}"),
        "R": ("(unit of the output)^2", "Variances of sensors that are known.", "{gauge: 4.0e-6}"),
        "initial_state": (
            "of the state",
            "State in the first row. Left out: nominal values, of linear plants zero.",
            "{level: 1.2}",
        ),
        "initial_covariance": (
            "(unit of the state)^2",
            "Variances of the state in the first row: one number, or by name.",
            "{level: 0.01}",
        ),
        "input_delay": (
            "rows",
            "By how many rows inputs act later than the plant assumes; `auto` tries several.",
            "auto",
        ),
        "method": ("", "`simulation` stops at the fit of simulations.", "innovations"),
        "integration": ("", "How equations are stepped. Left out: `auto`.", "radau"),
        "substeps": ("", "Steps of the integration in one sample.", "4"),
        "level": ("", "Probability that the box holds all constants. Left out: 0.95.", "0.95"),
        "starts": ("", "Number of fits, from the nominal constants and from random ones; the best is kept.", "5"),
        "seed": ("", "Seed of the random starts.", "0"),
        "sensor_noise": (
            "",
            "Outputs with coloured noise: its correlation time in seconds, or `unknown`. `{}` states that all noise is "
            "white. Left out: tried where the innovations ask for it.",
            "{T1: {correlation: unknown}}",
        ),
        "offset": (
            "",
            "Outputs whose constant offset is to be found; `{}` states that there is none.",
            "{T1: unknown}",
        ),
        "walks": ("", "Unknown inputs, faults and parameters that are random walks, to be found.", "{room: unknown}"),
        "digest": ("", "SHA-256 of the log that the numbers were found in; checked when it is read.", "9f86d081..."),
    },
    "MatrixFile": {
        "file": (
            "",
            "Matrix Market (`.mtx`), `.npz`, `.mat` or `.csv`, beside the spec. A `.csv` holds numbers alone, a row a "
            "line, separated by commas, semicolons, tabs or blanks, without a line of names.",
            "A.csv",
        ),
        "variable": ("", "Name of the matrix in the file.", "A"),
    },
    "VaryingFile": {
        "file": ("", "As above.", "A.npz"),
        "variable": ("", "As above.", "A"),
        "stack": ("", "Number of matrices that stand one below the other in the file, one for each k.", "60"),
    },
    "PoleRegion": {
        "decay": ("1/s", "Every movable pole decays at least this fast.", "0.5"),
        "radius": ("", "Discrete plants: largest absolute value.", "0.9"),
        "damping": ("", "Least damping ratio.", "0.7"),
    },
    "NoiseSection": {
        "measurement": ("of the outputs", "Standard deviation of each output: one number, a list, or by name.", "0.1"),
        "process": ("", "Weight of the noise that drives the states.", "1"),
        "fault": ("", "Weight of the noise that drives the fault model: larger is faster and noisier.", "1"),
    },
    "SensorTimes": {
        "every": ("rows", "A value in each so many rows.", "60"),
        "delay": ("rows", "By how many rows a value arrives later than it was taken.", "5"),
    },
}

#: Section of the page -> class of the schema, in order, with the words before its table.
SECTIONS: tuple[tuple[str, str, str], ...] = (
    (
        "Top level",
        "SpecDocument",
        "A spec is one YAML document. Keys that do not exist are refused, with what may be meant.",
    ),
    (
        "plant: constant matrices",
        "PlantSection",
        "`E x' = A x + B u + Bd d + Bf f + Bw w`, `y = C x + D u + Dd d + Df f + Dw w`; `x'` is the derivative for "
        "`dt: 0` and the next sample otherwise.",
    ),
    ("plant: in a file of its own", "PlantReference", ""),
    (
        "plant: equations",
        "DAESection",
        "With `kind: dae`: a nonlinear plant ([how to](../howto/nonlinear)). Nothing in the texts is executed as Python.",
    ),
    (
        "plant: matrices that change with time",
        "TimeVaryingSection",
        "With `kind: time-varying`: `E(k+1) x(k+1) = A(k) x(k) + B(k) u(k) + Phi(k) theta`, `y = C x + Psi theta`, each "
        "matrix as rows of numbers and expressions in `k`, a list of matrices, or a file.",
    ),
    ("plant.transform", "TransformSection", "In this order, before any method gets the plant."),
    ("plant.transform.linearise", "LineariseSection", "Arguments of `obsynth.linearise`."),
    (
        "plant.constants",
        "Constant",
        "A constant is a number, or a mapping with these keys: `constants: {k: 0.05, C1: {nominal: 2.0, tolerance: 5 %, "
        "unit: kJ/K}}`. One constant in several entries is one unknown. A name in a matrix that is written out, or in an "
        "equation, stands for the constant: `A: [[-k/C1, k/C1], ...]`.",
    ),
    ("plant.scheduling", "SchedulingSection", "One parameter, by its name."),
    ("plant.entries", "EntrySection", "One item of the list of a matrix."),
    ("plant.box", "BoxSection", "See [model uncertainty](../explanation/tolerances)."),
    ("plant.sensor_noise: coloured noise", "ColouredNoise", "In place of a number; see `obsynth.with_noise`."),
    ("A matrix in a file", "MatrixFile", "Wherever a matrix may stand."),
    ("Matrices that change with time, in a file", "VaryingFile", ""),
    (
        "scenario",
        "ScenarioSection",
        "For `simulate`, `evaluate`, `compare`, and what `run --system` and monitors expect.",
    ),
    ("scenario: profiles", "ProfileSection", "How one signal goes with time. Each kind takes the keys that name it."),
    ("inputs", "InputsSection", "See [your own data](../howto/data)."),
    (
        "calibrate",
        "CalibrateSection",
        "Arguments of `obsynth.calibrate`; see [from a log to a model](../howto/calibrate).",
    ),
    ("method", "MethodSection", "The options of each method follow."),
)
#: Sections that stand in an option of a method.
OPTION_SECTIONS: tuple[tuple[str, str, str], ...] = (
    ("A pole region", "PoleRegion", "Option `region` or `poles` of methods that place poles."),
    ("Noise weights", "NoiseSection", "Option `noise` of `ui-pi-observer`."),
    ("Times of a sensor", "SensorTimes", "Option `sensors` of recursive and nonlinear methods, by output."),
)
