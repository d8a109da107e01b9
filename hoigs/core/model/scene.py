"""SceneModel: the only place where a forward pass is composed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate

import torch
from torch import Tensor, nn

from hoigs.core.errors import HoigsError, PluginError, require_type
from hoigs.core.fast.streams import apart
from hoigs.core.interfaces.decoder import Decoder
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.interfaces.interaction import InteractionModule, check_tokens
from hoigs.core.interfaces.rasterizer import Rasterizer, RenderOutput, RenderRequest
from hoigs.core.model.entity import Entity, call, name_of, require_residuals, require_tokens
from hoigs.core.system.files import require_entity_name
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.shown import html_table
from hoigs.core.values.tokens import Residual, Role, Tokens


@dataclass(frozen=True)
class SceneState:
    """All entities at one moment, by name and in the scene's order.

    Attributes:
        gaussians: raw, world. residuals, tokens: empty where the interaction did not run.
        whole: all of `gaussians` in one, if it has been computed already.
        moment: on the model's device; None where it is not known there.
    """

    gaussians: Mapping[str, Gaussians]
    residuals: Mapping[str, Residual]
    tokens: Mapping[str, Tokens]
    whole: Gaussians | None = None
    moment: Moment | None = None

    def joined(self, only: Iterable[str] | None = None) -> Gaussians:
        """The Gaussians of all entities, or of those in `only`, in the scene's order."""
        names = set(self.gaussians if only is None else only)
        if self.whole is not None and names >= set(self.gaussians):
            return self.whole
        return Gaussians.cat([g for name, g in self.gaussians.items() if name in names])

    def slices(self, only: Iterable[str] | None = None) -> dict[str, slice]:
        """Rows of each entity in `joined(only)`."""
        names = set(self.gaussians if only is None else only)
        return _rows({n: len(g) for n, g in self.gaussians.items() if n in names})


class SceneModel(nn.Module):
    """Entities, the interaction between them, and the rasterizer that draws them.

    moment -> features -> interaction -> deformation -> Gaussians(t) -> rasterizer [-> decoder]
    -> image

    Args:
        entities: by name; their order decides that of the joined Gaussians.
        interaction: couples the entities that have features; None couples nothing.
        rasterizer: any backend; `model.rasterizer` may be replaced at any time.
        decoder: makes the picture from what was drawn; None takes the colours as they are drawn.
        low_pass: variance added to the screen covariance, square pixels, wherever the model is
            drawn: it learns its Gaussians with one value, and looks too thin or too soft with
            another. antialiased: likewise, whether opacities make up for it (`RenderRequest`).

    Attributes:
        interaction_enabled: False during the warm-up of the interaction.

    Raises:
        ValueError: there are no entities, one has a name that none can have, or its features
            declare other tokens than the interaction needs.
        TypeError: an argument is of another type.
        HoigsError: parameters of several dtypes, or of float32 where torch's default is another.
    """

    def __init__(
        self,
        entities: Mapping[str, Entity],
        *,
        interaction: InteractionModule | None = None,
        rasterizer: Rasterizer,
        decoder: Decoder | None = None,
        low_pass: float = 0.3,
        antialiased: bool = False,
    ) -> None:
        super().__init__()
        if not entities:
            raise ValueError("SceneModel needs at least one entity")
        for name, entity in entities.items():
            require_entity_name(name)
            require_type("SceneModel", f"entities[{name!r}]", entity, Entity)
        require_type("SceneModel", "rasterizer", rasterizer, Rasterizer)
        if interaction is not None:
            require_type("SceneModel", "interaction", interaction, InteractionModule)
        if decoder is not None:
            require_type("SceneModel", "decoder", decoder, Decoder)
        self.entities = nn.ModuleDict(entities)
        self.interaction = interaction
        self.interaction_enabled = True
        self.rasterizer = rasterizer
        self.decoder = decoder
        self.low_pass = low_pass
        self.antialiased = antialiased
        if interaction is not None:
            described = {n: e.features for n, e in entities.items() if e.features is not None}
            for name, features in described.items():
                check_tokens(interaction, features, entities[name].kind)
            interaction.bind(
                {name: features.width for name, features in described.items()},
                {name: entity.kind for name, entity in entities.items()},
            )
        self._check_dtypes()

    def _check_dtypes(self) -> None:
        """Clips and bodies are of float32, networks and constants of torch's default dtype."""
        default, first = torch.get_default_dtype(), dict[torch.dtype, str]()
        for name, parameter in self.named_parameters():
            first.setdefault(parameter.dtype, name)
        if len(first) > 1 or (torch.float32 in first and default != torch.float32):
            found = " and ".join(f"{name} is {dtype}" for dtype, name in first.items())
            raise HoigsError(
                f"SceneModel: {found}, and torch's default dtype is {default}; expected "
                "torch.float32 throughout: torch.set_default_dtype(torch.float32) before the "
                "model is made and as long as it is used"
            )

    def entity(self, name: str) -> Entity:
        entity = self.entities[name]
        assert isinstance(entity, Entity)
        return entity

    def names(self, kind: str | None = None) -> list[str]:
        """Names of all entities, or of those of a kind: "scene", "human" or "object"."""
        return [n for n in self.entities if kind is None or self.entity(n).kind == kind]

    @contextmanager
    def interacting(self, enabled: bool) -> Iterator[None]:
        """`interaction_enabled` in the block only."""
        before, self.interaction_enabled = self.interaction_enabled, enabled
        try:
            yield
        finally:
            self.interaction_enabled = before

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def forward(self, moment: Moment, only: Iterable[str] | None = None) -> SceneState:
        """Every entity, or those in `only`, at `moment`.

        The interaction reads all entities, also those that are not in `only`.

        Args:
            moment: on the model's device.

        Raises:
            PluginError: tokens or a residual have a shape that does not fit; it names the component
                that gave them. TypeError: `moment` is none.
        """
        if torch.get_default_dtype() != torch.float32:  # else it was checked when it was made
            self._check_dtypes()
        require_type("SceneModel", "moment, the first argument,", moment, Moment)
        names = list(self.entities if only is None else only)
        tokens: dict[str, Tokens] = {}
        extractors: dict[str, FeatureExtractor] = {}
        residuals: Mapping[str, Residual] = {}
        module = self.interaction
        if module is not None and module.reads and self.interaction_enabled:
            seen = apart({n: partial(self._described, n, moment) for n in self.entities}, moment)
            for name, (described, _) in seen.items():
                features = self.entity(name).features
                if described is not None and features is not None:
                    require_tokens(features, name, described, len(self.entity(name)))
                    tokens[name], extractors[name] = described, features
            roles = {name: role for name, (_, role) in seen.items()}
            residuals = call(module, "interaction", module, tokens, roles)
            require_residuals(module, residuals, tokens, extractors, self.count())
        moved = {name: partial(self._moved, name, moment, residuals.get(name)) for name in names}
        gaussians = apart(moved, (moment, residuals))
        return SceneState(gaussians, residuals, tokens, moment=moment)

    def _described(self, name: str, moment: Moment) -> tuple[Tokens | None, Role]:
        """What the interaction reads of an entity."""
        entity = self.entity(name)
        tokens = call(entity.features, f"features of {name!r}", entity.tokens, moment)
        return tokens, entity.role(moment)

    def _moved(self, name: str, moment: Moment, residual: Residual | None) -> Gaussians:
        entity, role = self.entity(name), f"deformation of {name!r}"
        found = call(entity.deformation, role, entity, moment, residual)
        self._require_channels(role, entity.deformation, found)
        return found

    def render(
        self,
        moment: Moment,
        camera: Camera,
        *,
        only: Iterable[str] | None = None,
        background: Tensor | None = None,
        request: RenderRequest | None = None,
    ) -> RenderOutput:
        """Draw all entities, or those in `only`, at any moment from any camera.

        Args:
            moment, camera: on the model's device.
            background: RGB in [0, 1], [3]; in place of `request.background`.
            request: as for `draw`.

        Raises:
            TypeError: an argument is of another type, as where both are swapped.
        """
        require_type("SceneModel.render", "moment, the first argument,", moment, Moment)
        require_type("SceneModel.render", "camera, the second argument,", camera, Camera)
        state = self(moment, only)
        request = request or RenderRequest()
        if background is not None:
            request = request.replace(background=background)
        return self.draw(state.joined(), camera, request, moment)

    def draw(
        self,
        gaussians: Gaussians,
        camera: Camera,
        request: RenderRequest | None = None,
        moment: Moment | None = None,
    ) -> RenderOutput:
        """The picture of Gaussians of this model, which `forward` or `SceneState` gives.

        Args:
            request: everything that a rasterizer can be requested to do, but for `low_pass` and
                `antialiased`, which are the model's.
            moment: of the Gaussians, on their device; a decoder needs it.

        Raises:
            HoigsError: the model has a decoder, and there is no moment.
            PluginError: the decoder gives something else than a picture.
        """
        decoder = self.decoder
        if decoder is None:
            return self.rasterize(gaussians, camera, request)
        if moment is None:
            raise HoigsError(
                f"SceneModel.draw: the decoder of this model, {name_of(decoder)}, needs the "
                "moment: draw(gaussians, camera, request, moment); `rasterize` draws without it"
            )
        request, channels = request or RenderRequest(), gaussians.channels
        if channels is None:
            channels = gaussians.means.new_zeros(len(gaussians), decoder.channels)
        asked = gaussians.means.new_zeros(len(gaussians), 0)
        if request.features is not None:
            asked = request.features
        both = torch.cat((asked, channels), 1)
        drawn = self.rasterize(
            gaussians, camera, request.replace(features=both if both.shape[1] else None)
        )
        further = own = None
        if drawn.features is not None:
            further, own = drawn.features.split((asked.shape[1], channels.shape[1]), -1)
        drawn = replace(drawn, features=own if decoder.channels else None)
        color = call(decoder, "decoder", decoder, drawn, camera, moment)
        if color.shape != drawn.color.shape:
            raise PluginError(
                f"decoder: {name_of(decoder)} gave a picture {list(color.shape)}, expected "
                f"{list(drawn.color.shape)}"
            )
        features = None if request.features is None else further
        return replace(drawn, color=color, features=features)

    def _require_channels(self, role: str, part: object, gaussians: Gaussians) -> None:
        """Raise PluginError where channels are no row a Gaussian, or not those that are decoded."""
        channels = gaussians.channels
        if channels is None:
            return
        width = channels.shape[-1] if self.decoder is None else self.decoder.channels
        if tuple(channels.shape) != (len(gaussians), width):
            reads = "" if self.decoder is None else f", as {name_of(self.decoder)} reads {width}"
            raise PluginError(
                f"{role}: {name_of(part)} gave channels {list(channels.shape)}, expected "
                f"[{len(gaussians)}, {width}]{reads}"
            )

    def rasterize(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        """Draw any Gaussians in their own colours, without the decoder; `request` as for `draw`."""
        request = (request or RenderRequest()).replace(
            low_pass=self.low_pass, antialiased=self.antialiased
        )
        rasterizer = self.rasterizer
        return call(rasterizer, "rasterizer", rasterizer.render, gaussians, camera, request)

    def set_progress(self, progress: float) -> None:
        """Pass the done share of the training run, in [0, 1], to every deformation."""
        for name in self.entities:
            self.entity(name).deformation.set_progress(progress)

    def count(self) -> dict[str, int]:
        """The number of Gaussians of each entity."""
        return {name: len(self.entity(name)) for name in self.entities}

    def rows(self) -> dict[str, slice]:
        """Rows of each entity in the Gaussians of all, as `SceneState.joined` has them."""
        return _rows(self.count())

    def _repr_html_(self) -> str:
        rows = []
        for name in self.entities:
            entity = self.entity(name)
            features = "–" if entity.features is None else type(entity.features).__name__
            parts = (type(entity.deformation).__name__, features)
            numbers = sum(p.numel() for p in entity.parameters() if p.requires_grad)
            rows.append((name, entity.kind, f"{len(entity):,}", f"{numbers:,}", *parts))
        interaction = "no" if self.interaction is None else type(self.interaction).__name__
        drawn = f"{type(self.rasterizer).__name__} on {self.device}, {interaction} interaction"
        if self.decoder is not None:
            drawn += f", decoded by {type(self.decoder).__name__}"
        columns = ("entity", "kind", "Gaussians", "parameters", "deformation", "features")
        return html_table(f"SceneModel: {drawn}", columns, rows)


def _rows(counts: Mapping[str, int]) -> dict[str, slice]:
    ends = accumulate(counts.values())
    return {n: slice(e - count, e) for (n, count), e in zip(counts.items(), ends, strict=True)}
