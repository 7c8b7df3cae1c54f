"""Training profiles: the numbers of a fit, by name."""

import dataclasses
from typing import Literal

from keepout.core.errors import FieldError

LARGE_TARGET = 20.0
"""Metres. A target whose bounding ball is larger gets the profile's numbers for large targets, where it has any."""
BEYOND_CONTACT = 0.7
"""Metres that the near field reaches beyond where a chaser touches."""


@dataclasses.dataclass(frozen=True)
class TrainingProfile:
    """The numbers of a fit.

    Attributes:
        loss: "keepout": pinball on the distance, weighted towards the surface, and exact gradients where one surface
            decides.
            "paper_pinball": the paper's loss with L_P read as κ max(e, 0) + max(-e, 0), e = f̃ - d. "paper_printed":
            L_P = (κ-1) max(e, 0) as printed, whose minimum is f̃ → -∞.
        width, depth: hidden layers.
        beta: sharpness of the softplus, in normalised units.
        samples: labelled points.
        batch: points a step.
        steps: of the main phase.
        tuning_steps: of the counter-example phase.
        webs: worst under-statements of the near field that a round of the counter-example phase keeps. Without them
            webs grow in the corners between panels; with as many as of the over-statements the surface suffers.
        near: metres; errors count in proportion to near/(|g| + near), g the signed distance, so that the surface
            matters most and the far field is not lost (keepout loss).
        room_share: share of the samples that are spread over the room next to the surface (`sampling.room_points`);
            the rest has few in gaps that are wide, and small beside the target.
        optimizer: "adam" (Kingma, Ba 2015), or "muon" (Jordan et al. 2024): momentum made orthogonal for the hidden
            matrices, Adam for the rest.
        learning_rate: of Adam, at the start.
        adam_b2: Adam's decay of the second moment.
        muon_rate: of the hidden matrices under Muon, at the start.
        halving: steps after which the learning rate halves; 0: cosine decay over the phase.
        over_weight: weight of over-statement against under-statement, 0.5 to 1, in the near field (keepout loss).
        far_over_weight: the same beyond the near field, where over-statement costs no safety.
        near_field: metres from the surface up to which over-statement is held and hunted; `for_chaser` extends it.
        gradient_weight: of the gradient term (keepout), or η of the eikonal term (paper).
        kappa: κ of the paper's loss.
        large: the numbers for a target larger than `LARGE_TARGET`; None: the same.

    """

    loss: Literal["keepout", "paper_pinball", "paper_printed"] = "keepout"
    width: int = 96
    depth: int = 4
    beta: float = 100.0
    samples: int = 600_000
    batch: int = 2048
    steps: int = 8_000
    tuning_steps: int = 4_000
    webs: int = 500
    near: float = 0.15
    room_share: float = 0.0
    optimizer: Literal["adam", "muon"] = "muon"
    learning_rate: float = 5e-3
    adam_b2: float = 0.99
    muon_rate: float = 0.01
    halving: int = 0
    over_weight: float = 0.8
    far_over_weight: float = 0.8
    near_field: float = 1.2
    gradient_weight: float = 0.02
    kappa: float = 2.0
    large: "TrainingProfile | None" = None

    def for_size(self, radius: float) -> "TrainingProfile":
        """Return the numbers for a target whose bounding ball has this radius, metres."""
        return self if self.large is None or radius <= LARGE_TARGET else self.large

    def for_chaser(self, radius: float) -> "TrainingProfile":
        """Return the numbers for a chaser of this radius, metres: the near field reaches beyond where it touches."""
        return dataclasses.replace(self, near_field=max(self.near_field, radius + BEYOND_CONTACT))


_STATION = TrainingProfile(
    width=160,
    depth=5,
    steps=10_000,
    tuning_steps=7_000,
    webs=300,
    near=0.4,
    room_share=0.25,
    over_weight=0.65,
    far_over_weight=0.5,
)
_PAPER = TrainingProfile(
    loss="paper_pinball",
    width=512,
    depth=10,
    samples=50_000,
    batch=50_000,
    steps=10_000,
    tuning_steps=0,
    optimizer="adam",
    learning_rate=5e-3,
    adam_b2=0.999,
    halving=2000,
    gradient_weight=0.1,
)

PROFILES: dict[str, TrainingProfile] = {
    "default": TrainingProfile(large=_STATION),
    "quick": TrainingProfile(width=48, depth=3, samples=60_000, steps=1500, tuning_steps=500),
    "paper": _PAPER,
    "paper_printed": dataclasses.replace(_PAPER, loss="paper_printed"),
}


def find_profile(profile: str | TrainingProfile) -> TrainingProfile:
    """Return a profile by name; a `TrainingProfile` is returned as it is.

    Raises:
        FieldError: no profile of that name.

    """
    if isinstance(profile, TrainingProfile):
        return profile
    if profile not in PROFILES:
        raise FieldError(f"profile {profile!r}: there is none of that name; choose from {', '.join(PROFILES)}")
    return PROFILES[profile]
