"""The commands of ``pace``: their configurations, and the keys that the command line may give."""

from __future__ import annotations

from dataclasses import dataclass, field

from pace.config.overrides import TASK_GROUPS, TASK_VALUES

#: Groups of the training, in the order of configs/train.yaml.
TRAIN_GROUPS = (
    "robot", "ball", "serve", "reset", "reward", "randomization", "sensing", "observation", "engine", "algo",
    "predictor", "experiment",
)  # fmt: skip
#: Of commands that only play: no reward is computed there.
NO_REWARD: dict[str, str] = dict.fromkeys(
    ("reward.terms", "reward.scale"), "no reward is computed; pace train and pace watch do that"
)
CHECKPOINT_ERROR = "pace.runs.checkpoint:CheckpointError"
SAVED_RUN = (
    "RUN is a run folder, a checkpoint in one, or the name of a published policy (campaign). The task is the one saved "
    "with the policy; change it as in training, by a choice of a group (ball=paper) or a value "
    "(engine.solver_iterations=20)."
)


@dataclass(frozen=True)
class Command:
    """One command. ``--help`` shows it, and arguments are checked against it."""

    module: str  # python -m <module> is the same as pace <name>
    work: str  # module:function of the composed configuration, imported when there is one
    config: str  # configs/<config>.yaml, whose keys it takes
    summary: str  # one line
    failures: tuple[str, ...] = ()  # module:error of its expected errors
    usage: str = "[key=value ...]"  # the text after its name
    about: str = ""  # a paragraph of the help
    examples: tuple[str, ...] = ()  # without the command's name
    positional: tuple[str, ...] = ()  # keys of the arguments without a key, in order
    rest: str = ""  # key of the list that takes all arguments without a key
    options: tuple[str, ...] = ()  # keys that may be written --key value
    flags: tuple[str, ...] = ()  # keys that may be written --key, for key=true
    groups: tuple[str, ...] = ()  # choices of configs/ that it takes, and single values of them
    training_keys: tuple[str, ...] = ()  # keys of configs/train.yaml that it takes besides its own
    collected: bool = False  # arguments of `groups` and `training_keys` go into its key `overrides`, as a list
    extra: str = ""  # extra of the package that it may need
    refused: dict[str, str] = field(default_factory=dict)  # key or group without effect -> the one to use instead


COMMANDS = {
    "train": Command(
        module="pace.rl.train",
        work="pace.rl.train:train_from_config",
        failures=("pace.distributed:ProcessGroupError", "pace.rl.rollout:RolloutError", CHECKPOINT_ERROR),
        config="train",
        summary="train a policy and its predictor",
        about="Writes a run folder: configuration, versions, metrics, checkpoints and learning curve. Ctrl-C saves and "
        "ends; resume= resumes exactly there.",
        examples=(
            "minutes=10 num_worlds=512 seed=3",
            "experiment=paper device=cuda     # the paper's numbers",
            "resume=runs/2026-01-01_pace minutes=60",
            "init_from=runs/2026-01-01_pace ball=paper",
            "reward.terms.success.weight=200 algo.gamma=0.97",
        ),
        groups=TRAIN_GROUPS,
    ),
    "evaluate": Command(
        module="pace.evaluation",
        work="pace.evaluation.evaluate:evaluate_from_config",
        failures=("pace.evaluation.serves:EvaluationError", CHECKPOINT_ERROR),
        config="evaluate",
        summary="hits and returns of a policy in the paper's serve ranges, and its robustness (--sweep)",
        usage="RUN [--sweep] [key=value ...]",
        about=SAVED_RUN + " policy=zero and policy=random need no RUN. --sweep also plays the task with one change at "
        "a time; with rows=[] only the sweep runs, and out=FOLDER resumes an interrupted sweep.",
        examples=(
            "pretrained/pace serves=500 sensing=paper ball=paper",
            "runs/2026-01-01_pace rows=[mixed] engine=mjwarp",
            "policy=random serves=500 physics_dt=0.01",
            "runs/2026-01-01_pace --sweep rows=[] out=runs/sweep",
        ),
        positional=("run",),
        flags=("sweep",),
        groups=(*TASK_GROUPS, "engine"),
        training_keys=TASK_VALUES,
        collected=True,
        refused={"serve": "rows= names the serve ranges, such as rows=[short]", **NO_REWARD},
    ),
    "play": Command(
        module="pace.viewer",
        work="pace.viewer.play:play_from_config",
        failures=(
            CHECKPOINT_ERROR,
            "pace.sim.render:RenderError",
            "pace.viewer.server:PageError",
            "pace.sim.replay:ReplayError",
        ),
        extra="viewer",
        config="play",
        summary="a policy on a live page in the browser, or in a video (--video FILE)",
        usage="[RUN] [--video FILE.mp4] [key=value ...]",
        about=SAVED_RUN + " A file of a run's replays/ shows what went wrong in its training.",
        examples=(
            "pretrained/pace",
            "pretrained/pace ball=paper serve=short port=9000",
            "runs/2026-01-01_pace --video out.mp4 seconds=30 speed=0.25",
            "policy=zero serve=short        # the task, before there is a policy: also policy=random",
        ),
        positional=("run",),
        options=("video",),
        groups=(*TASK_GROUPS, "engine"),
        training_keys=TASK_VALUES,
        collected=True,
        refused=NO_REWARD,
    ),
    "watch": Command(
        module="pace.viewer.watch",
        work="pace.viewer.following:watch_from_config",
        failures=(CHECKPOINT_ERROR, "pace.viewer.server:PageError"),
        extra="viewer",
        config="watch",
        summary="the newest policy of a run that trains, on a live page with its reward terms",
        usage="RUN [key=value ...]",
        about="The page of pace play, which takes each new checkpoint of the run when it is written. Start it in a "
        "second terminal; it waits for the first checkpoint.",
        examples=("runs/2026-01-01_pace", "runs/2026-01-01_pace port=9000 serve=short rewards=false"),
        positional=("run",),
        groups=(*TASK_GROUPS, "engine"),
        training_keys=TASK_VALUES,
        collected=True,
    ),
    "export": Command(
        module="pace.deploy",
        work="pace.deploy.export:export_from_config",
        failures=("pace.deploy.export:ExportError", CHECKPOINT_ERROR),
        extra="export",
        config="export",
        summary="a policy as one ONNX file for the robot, checked against torch",
        usage="RUN [key=value ...]",
        about="RUN is a run folder, a checkpoint in one, or the name of a published policy (campaign). Writes "
        "policy.onnx into the folder out.",
        examples=("pretrained/pace", "runs/2026-01-01_pace out=runs/robot"),
        positional=("run",),
    ),
    "retrace": Command(
        module="pace.deploy.retrace",
        work="pace.deploy.trace:retrace_from_config",
        failures=("pace.deploy.trace:RetraceError",),
        extra="export",
        config="retrace",
        summary="a robot's log through the exported file: where its targets part from the recorded ones",
        usage="POLICY LOG [key=value ...]",
        about="POLICY is policy.onnx or its folder, LOG what the robot has recorded (docs/robot.md). Prints the first "
        "step at which they part, and what was unusual: late steps, old frames, readings that the policy refuses.",
        examples=("robot/policy.onnx robot/monday.log", "robot robot/monday.log tolerance=1e-3 out=runs/monday"),
        positional=("policy", "log"),
    ),
    "ablate": Command(
        module="pace.studies.ablate",
        work="pace.studies.ablation:ablate_from_config",
        failures=("pace.studies.ablation:AblationError", CHECKPOINT_ERROR),
        config="ablate",
        summary="experiments x seeds, trained one after another, and a figure to compare them",
        about="Runs, CSVs and figure are in the folder out. The same command again skips finished runs and resumes the "
        "others. Keys and choices of the training change every run.",
        examples=(
            "out=runs/ablation jobs=2",
            "experiments=[ablation/baseline,paper] seeds=[7] samples=4e6 num_worlds=512",
            "train=false out=docs/results/recipe     # table and figure again, from the CSVs",
        ),
        groups=tuple(group for group in TRAIN_GROUPS if group != "experiment"),
        training_keys=(
            "num_worlds",
            "processes",
            "device",
            "curriculum",
            "checkpoint_minutes",
            "tensorboard",
            "logger",
            "plugins",
        ),
        collected=True,
        refused={"experiment": "experiments= names them", "seed": "seeds= lists them", "minutes": "samples= ends runs"},
    ),
    "compare": Command(
        module="pace.studies.compare",
        work="pace.studies.comparison:compare_from_config",
        failures=("pace.evaluation.serves:EvaluationError", CHECKPOINT_ERROR),
        config="compare",
        summary="learning curves of runs, seeds as bands, and two policies on the same serves",
        usage="RUN [RUN ...] [key=value ...]",
        about="RUN is a run folder, a checkpoint, pretrained/<name>, or a CSV that pace ablate wrote. Runs whose "
        "configurations differ in the seed alone are one curve with a band. Exactly two policies also play the same "
        "serves, for paired intervals, on one task (task=table) that is changed as in training.",
        examples=(
            "runs/a_seed1 runs/a_seed2 runs/b_seed1 runs/b_seed2",
            "pretrained/pace pretrained/campaign serves=5000 rows=[short,mixed] ball=paper",
            "runs/a runs/b play=false out=runs/comparison",
        ),
        rest="runs",
        groups=(*TASK_GROUPS, "engine"),
        training_keys=TASK_VALUES,
        collected=True,
        refused={"serve": "rows= names the serve ranges, such as rows=[short]", **NO_REWARD},
    ),
    "keep": Command(
        module="pace.evaluation.keep",
        work="pace.evaluation.publish:keep_from_config",
        failures=("pace.evaluation.publish:KeepError", CHECKPOINT_ERROR),
        config="keep",
        summary="publish a policy: weights, metrics, evaluation and model card in one small folder",
        usage="RUN FOLDER [--evaluation FOLDER] [--notes FILE.md]",
        about="FOLDER must be new or empty, or hold a policy that this command wrote, which is replaced.",
        examples=("runs/my_run pretrained/mine --evaluation runs/my_evaluation --notes notes.md",),
        positional=("run", "out"),
        options=("evaluation", "notes"),
    ),
    "bench": Command(
        module="pace.bench",
        work="pace.bench.measure:bench_from_config",
        failures=("pace.bench.training:BenchError",),
        config="bench",
        summary="speed and memory of physics, environment, PPO update and training on this machine",
        about="Writes bench.json. Choices and values of the training change what is measured; keep the machine idle.",
        examples=("bench=quick num_worlds=64", "bench.parts=[physics,update] bench.repeats=11"),
        groups=("bench", *TRAIN_GROUPS),
        training_keys=("name", "num_worlds", "processes", "device", "seed", "init_from", "out", "plugins"),
        refused={"samples": "bench.train_updates says how long it trains", "minutes": "it ends by itself"},
    ),
    "validate": Command(
        module="pace.studies.ball",
        work="pace.studies.ball_figures:validate_from_config",
        extra="dev",
        config="validate",
        summary="the ball's flight and rebounds against independent solutions (extra dev)",
        about="Prints the numbers of docs/results/physics.md and draws its figures.",
    ),
    "predictor": Command(
        module="pace.predictor",
        work="pace.rl.predictor_run:train_predictor",
        config="predictor_train",
        summary="train the predictor alone, on simulated serves without a robot",
        about="Ball, serves, sensing and their randomisation are those of the training. A policy starts with the "
        "result by init_from=RUN or predictor_from=RUN.",
        examples=("predictor=paper sensing=clean samples=2e6", "predictor=filter randomization=wide minutes=4"),
        groups=(
            "robot",
            "ball",
            "serve",
            "reward",
            "randomization",
            "sensing",
            "engine",
            "algo",
            "predictor",
            "experiment",
        ),
        training_keys=(
            "name",
            "num_worlds",
            "device",
            "seed",
            "samples",
            "minutes",
            "checkpoint_minutes",
            "out",
            "tensorboard",
            "logger",
            "progress",
            "plugins",
        ),
    ),
    "studies": Command(
        module="pace.studies",
        work="pace.studies.catalogue:study_from_config",
        failures=(CHECKPOINT_ERROR,),
        extra="dev",
        config="studies",
        summary="measurements of engines, step sizes, motors, predictors, ... (extra dev)",
        usage="STUDY [STUDY ...] [key=value ...]",
        about="Prints the tables of the documentation and draws their figures. STUDY: reaction, parity, steps, solver, "
        "motors, robots, ankles, predictor, adaptation, senses, rounding, serves, recipe, learning, memory, soak, "
        "page, architecture, or all.",
        examples=("parity worlds=16", "steps solver run=pretrained/pace", "predictor serves=512 cases=[rubber]"),
        rest="studies",
    ),
    "warm": Command(
        module="pace.rl.warm",
        work="pace.rl.kernels:warm_from_config",
        config="warm",
        summary="compile the kernels of a training run, so that it begins at once",
        about="pace train does this first on a machine that has none. With arch=sm_90 it compiles for a GPU that is "
        "not there: WARP_CACHE_PATH names the folder, which may be copied to a machine with the GPU.",
        examples=("device=cuda", "arch=sm_90 experiment=generalist     # for an image that is built without a GPU"),
        groups=TRAIN_GROUPS,
        training_keys=("device", "curriculum", "plugins"),
        refused=dict.fromkeys(("samples", "minutes", "out", "resume"), "nothing is trained"),
    ),
}
