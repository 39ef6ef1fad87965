"""The commands that show a policy: play and watch."""

from __future__ import annotations

from dataclasses import dataclass, field

from pace.config.base import require


@dataclass(kw_only=True)
class PageConfig:
    """What both have: the run and its page."""

    run: str | None
    host: str
    port: int
    speed: float  # of time; 1: real time
    seed: int
    physics_dt: float  # s
    overrides: list[str]  # of the saved task
    plugins: list[str] = field(default_factory=list)  # modules that add what the saved task needs

    def __post_init__(self) -> None:
        require(0 < self.speed <= 1, f"speed must lie in (0, 1], got {self.speed}")
        require(1 <= self.port <= 65535, f"port must lie in 1 to 65535, got {self.port}")


@dataclass(kw_only=True)
class PlayConfig(PageConfig):
    """``python -m pace.viewer``: the policy, and the page or the video."""

    policy: str  # run, zero, random
    video: str | None
    seconds: float  # of play
    width: int  # pixels of each view
    height: int
    fps: int
    view: str = "both"  # both or strike

    def __post_init__(self) -> None:
        require(self.run is not None, "which run? give its folder, a checkpoint or pretrained/<name>")
        require(self.policy in ("run", "zero", "random"), f"policy must be run, zero or random, not {self.policy!r}")
        super().__post_init__()
        known = self.video is None or self.video.endswith((".mp4", ".webp", ".gif"))
        require(known, f"video must end in .mp4, .webp or .gif, got {self.video}")
        require(self.view in ("both", "strike"), f"view must be both or strike, got {self.view}")
        for name in ("seconds", "fps"):
            require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name)}")
        for name in ("width", "height"):
            value = getattr(self, name)
            require(value > 0 and value % 2 == 0, f"{name} must be an even number of pixels, got {value}")


@dataclass(kw_only=True)
class WatchConfig(PageConfig):
    """``python -m pace.viewer.watch``: the run that trains, and the page."""

    rewards: bool

    def __post_init__(self) -> None:
        require(self.run is not None, "which run? give its folder, which pace train has named")
        super().__post_init__()
