"""Conformance of decoders: `CHECKS`, on pictures made up of random colours and channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.decoder import Decoder
from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import Moment
from hoigs.testing import modules
from hoigs.testing.checks import CheckList, require, require_close, require_finite
from hoigs.testing.material import camera_at, moment_at, tiny_clip
from hoigs.testing.modules import (
    ModuleSubject,
    perturb,
    require_same,
    require_true_gradients,
    seeded,
    trained,
    unchanged,
    weighted_sum,
)

TIMES = (0.4, 0.0, 1.0, 0.77)
MARGIN = 4  # pixels from the border of a part within which it may differ from the whole


@dataclass(frozen=True)
class Drawn:
    """What a decoder gets."""

    output: RenderOutput
    camera: Camera
    moment: Moment

    def with_output(self, **changes: Any) -> Drawn:
        return replace(self, output=replace(self.output, **changes))

    def part(self, left: int, top: int, width: int, height: int) -> Drawn:
        """A part of the image, as if it had been drawn alone."""
        rows, columns = slice(top, top + height), slice(left, left + width)
        fields = ("color", "alpha", "depth", "features")
        cut = {name: x[rows, columns] for name, x in self.tensors().items() if name in fields}
        camera = self.camera.cropped(left, top, width, height)
        return replace(self.with_output(**cut), camera=camera)

    def tensors(self) -> dict[str, Tensor]:
        parts = (self.output, self.camera, self.moment)
        named = {name: x for part in parts for name, x in vars(part).items()}
        return {name: x for name, x in named.items() if isinstance(x, Tensor)}


class DecoderSubject(ModuleSubject[Decoder]):
    """The component under check."""

    def made(
        self, *, seed: int = 0, perturbed: bool = True, dtype: torch.dtype = torch.float32
    ) -> Decoder:
        context = BuildContext(clip=tiny_clip())
        decoder = seeded(lambda: self.cls.from_config(self.config, context), seed)
        if perturbed:
            perturb(decoder, size=0.2)
        return decoder.to(device=self.device, dtype=dtype).eval()

    def drawn(
        self, time: float = 0.4, *, empty: bool = False, dtype: torch.dtype = torch.float32
    ) -> Drawn:
        """A picture; half of its last quarter is empty, or all of it."""
        camera = camera_at(time)
        generator = torch.Generator().manual_seed(7)
        height, width = camera.height, camera.width

        def random(*shape: int) -> Tensor:
            drawn = torch.rand(height, width, *shape, generator=generator)
            return drawn.to(self.device, dtype)

        alpha = random()
        alpha[height // 2 :, -width // 4 :] = 0
        if empty:
            alpha.zero_()
        count = self.made().channels
        channels = (2 * random(count) - 1) * alpha[..., None] if count else None
        color = random(3) * alpha[..., None] + (1 - alpha[..., None]) * 0.3
        output = RenderOutput(color, alpha, 3 * alpha * random(), channels)
        camera = camera.to(device=self.device, dtype=dtype)
        return Drawn(output, camera, moment_at(time, dtype, self.device))

    def cases(self, dtype: torch.dtype = torch.float32) -> Sequence[Drawn]:
        return [self.drawn(time, dtype=dtype) for time in TIMES]

    def outputs(self, made: Decoder, case: Drawn) -> dict[str, Tensor]:
        return {"picture": made(case.output, case.camera, case.moment)}


CHECKS: CheckList[DecoderSubject] = CheckList("K")
CHECKS.check("K02")(modules.keeps_dtype_and_device)
CHECKS.check("K08")(modules.same_seed_same_module)
CHECKS.check("K09")(modules.a_deep_copy_is_independent)
CHECKS.check("K10")(modules.cases_are_independent)
CHECKS.check("K05", modules.learns)(modules.every_parameter_gets_a_gradient)
CHECKS.check("K07")(modules.a_checkpoint_restores_it)
CHECKS.check("K14")(modules.rates_exist_in_the_spec)
subject = DecoderSubject.of


def reads_channels(subject: DecoderSubject) -> str | None:
    return None if subject.made().channels else "it reads no channels"


@CHECKS.check("K01")
def it_gives_a_picture(subject: DecoderSubject) -> None:
    """A finite picture [H, W, 3] of an image, of parts of it, and of one pixel."""
    whole = subject.drawn()
    for perturbed in (False, True):
        decoder = subject.made(perturbed=perturbed)
        for case in (whole, whole.part(2, 3, 11, 5), whole.part(0, 0, 1, 1)):
            picture = subject.outputs(decoder, case)["picture"]
            expected = [case.camera.height, case.camera.width, 3]
            got = list(picture.shape)
            require(got == expected, f"it is {got}, expected {expected}")
            require_finite("the picture", picture.detach())


@CHECKS.check("K03")
def the_background_stays(subject: DecoderSubject) -> None:
    """A picture in which nothing was drawn is its background, whatever that is."""
    empty, decoder = subject.drawn(empty=True), subject.made()
    for shade in (0.0, 0.3, 1.0):
        case = empty.with_output(color=torch.full_like(empty.output.color, shade))
        got = subject.outputs(decoder, case)["picture"].detach()
        require_close(f"over a background of {shade}", got, case.output.color, atol=1e-5)


@CHECKS.check("K04")
def a_part_is_as_in_the_whole(subject: DecoderSubject) -> None:
    """A part of the image is decoded as in the whole, but for 4 pixels from its border: the
    losses of people and objects are those of parts."""
    whole, decoder = subject.drawn(), subject.made()
    left, top, width, height = 6, 3, 12, 11
    part = subject.outputs(decoder, whole.part(left, top, width, height))["picture"].detach()
    everything = subject.outputs(decoder, whole)["picture"].detach()
    cut = everything[top : top + height, left : left + width]
    within = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    require_close("a part of the picture", part[within], cut[within], atol=1e-5)


@CHECKS.check("K06")
def gradients_are_derivatives(subject: DecoderSubject) -> None:
    """In float64, gradients of parameters, colours and channels agree with differences."""
    decoder, case = subject.made(dtype=torch.float64), subject.drawn(dtype=torch.float64)
    leaves = {
        name: x.clone().requires_grad_()
        for name, x in (("color", case.output.color), ("features", case.output.features))
        if x is not None
    }
    require_true_gradients(
        {**trained(decoder), **leaves},
        lambda: weighted_sum(subject.outputs(decoder, case.with_output(**leaves))),
    )


@CHECKS.check("K11")
def inputs_are_not_modified(subject: DecoderSubject) -> None:
    """What was drawn, the camera and the moment are not written to."""
    case, decoder = subject.drawn(), subject.made()
    with unchanged("", case.tensors()), torch.no_grad():
        subject.outputs(decoder, case)


@CHECKS.check("K12", reads_channels)
def every_channel_is_read(subject: DecoderSubject) -> None:
    """The picture depends on each of the declared channels."""
    case = subject.drawn()
    assert case.output.features is not None
    leaf = case.output.features.clone().requires_grad_()
    picture = subject.outputs(subject.made(), case.with_output(features=leaf))
    weighted_sum(picture).backward()
    slopes = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
    idle = (slopes.abs().amax((0, 1)) == 0).nonzero().flatten().tolist()
    require(not idle, f"no pixel depends on channels {idle} of {leaf.shape[-1]}")


@CHECKS.check("K13")
def time_may_be_a_tensor(subject: DecoderSubject) -> None:
    """A time that is a 0-d tensor, as films have it, gives the same as a number."""
    case, decoder = subject.drawn(), subject.made()
    time: Any = torch.tensor(case.moment.time).to(case.output.color)
    expected = subject.outputs(decoder, case)
    got = subject.outputs(decoder, replace(case, moment=replace(case.moment, time=time)))
    require_same("with a time in a tensor", got, expected, atol=1e-5)
