"""Memory of the robot's returns with what its rubber does: along the normal, and along the face."""

from __future__ import annotations

import torch
from torch import Tensor

from pace.onboard.estimate import Part
from pace.onboard.returns import ReturnMemory


class RubberMemory(ReturnMemory):
    """A :class:`ReturnMemory` that also estimates the share of the slip that a contact takes.

    Rubber that springs back takes up to 2/5 (1 + e_t) of the slip, about 0.7; a dead one 0.4, a slippery one less
    (:mod:`pace.sim.ball.rebound`). Topspin then leaves as lift: between 0.3 and 0.7 lie more than 1 m/s. With the
    velocities of :class:`ReturnMemory`, and the slip u of a ball that has ``bounce_spin`` of topspin,

        share = (v_before - v_after) . u / |u|^2

    is one estimate. A ball's own spin is not seen: what it adds to that of the bounce is an error of single estimates,
    which their mean takes out.
    """

    @staticmethod
    def parts(joints: int) -> dict[str, Part]:
        """See :class:`Estimate`."""
        parts = ReturnMemory.parts(joints)
        del parts["last_return"]
        meaning = "as last_return of the memory without it; estimated share minus its prior, and hits likewise"
        return parts | {"last_rubber": Part(7, "m/s, 1, 1, 1, 1", meaning)}

    def _learn(self, hit: Tensor, after: Tensor, seen: Tensor) -> Tensor:
        """``last_rubber`` (N, 7) with one more estimate of each; see :meth:`ReturnMemory._learn`."""
        before, paddle, normal = hit.split(3, dim=1)
        slip = self._slip(before, paddle, normal)
        taken = ((before - after - self.fall) * slip).sum(1, keepdim=True)
        squared = slip.square().sum(1, keepdim=True)
        counts = squared >= self.config.slip**2
        share = (taken / torch.where(counts, squared, 1.0)).clamp(0.0, self.config.largest_grip)
        grip = self._mean(seen[:, 5:], share - self.config.prior_grip, counts)
        return torch.cat((super()._learn(hit, after, seen[:, :5]), grip), dim=1)

    def _slip(self, before: Tensor, paddle: Tensor, normal: Tensor) -> Tensor:
        """Velocity (N, 3) of the ball's surface along the face, m/s, with topspin about the axis across its flight."""
        relative = before - paddle
        towards = (relative * normal).sum(1, keepdim=True)
        outward = torch.where(towards > 0.0, -normal, normal)  # from the paddle to the ball
        x, y = before[:, 0:1], before[:, 1:2]
        horizontal = (x.square() + y.square()).sqrt().clamp(min=1.0e-6)
        spin = self.config.bounce_spin / horizontal * torch.cat((-y, x, torch.zeros_like(x)), dim=1)
        at_contact = relative - self.config.radius * torch.linalg.cross(spin, outward)
        return at_contact - (at_contact * outward).sum(1, keepdim=True) * outward
