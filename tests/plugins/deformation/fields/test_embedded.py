"""deformation:embedded: its table, its schedule and its penalties."""

from __future__ import annotations

import math

import pytest
import torch
from field_cloud import cloud

from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.zoo.embedded import Embedded, EmbeddedConfig


def embedded(embedding: int, table: int, rows: int, coarse: int, **settings) -> Embedded:
    sizes = {"embedding": embedding, "table": table, "rows": rows, "coarse_rows": coarse}
    return Embedded(EmbeddedConfig(**sizes, **settings))


def test_embedded_starts_alike_for_all_and_grows_its_table():
    model = embedded(5, 8, 9, 3, fine_until=0.5, width=12)
    entity = Entity(cloud(), model)
    shift = entity(Moment(0.4)).means - entity.means
    torch.testing.assert_close(shift, shift[:1].expand_as(shift))  # zero codes: one motion
    model.set_progress(0.0)
    assert model.fine_rows == 3
    model.set_progress(0.25)
    assert model.fine_rows == 6
    model.set_progress(0.7)
    assert model.fine_rows == 9
    with torch.no_grad():
        model.time_table.copy_(torch.randn(9, 8))
    torch.testing.assert_close(model.time_code(0.25, 9), model.time_table[2])
    torch.testing.assert_close(model.time_code(0.5, 3), model.time_table[4])  # ends and middle
    model.config.anneal = 0.5
    model.set_progress(0.0)
    torch.testing.assert_close(entity(Moment(0.4)).means, entity.means)


def test_embedded_penalties_by_hand():
    model = embedded(2, 3, 4, 2, width=8, neighbours=1)
    canonical = Gaussians.from_points(torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [5.0, 0, 0]]))
    entity = Entity(canonical, model).train()
    with torch.no_grad():
        model.embedding.copy_(torch.tensor([[0.0, 0], [3, 4], [9, 9]]))
        model.time_table.copy_(torch.tensor([[0.0], [1], [3], [6]]).expand(4, 3))
    entity(Moment(0.0))
    found = {k: v.item() for k, v in entity.regularizers().items()}
    near = 5 * math.sqrt(math.exp(-2000 * 1e-4))  # the third is too far to count
    assert found["embedding_smoothness"] == pytest.approx(2 * near / 3, rel=1e-4)
    assert found["table_smoothness"] == pytest.approx(1.0)
    assert found["opacity"] == pytest.approx(0.1, rel=1e-4)
    model.config.table_smoothness = "last-row"
    assert float(entity.regularizers()["table_smoothness"]) == pytest.approx((9 + 0) / 2)
    assert "opacity" not in entity.regularizers()  # its graph was given away


def test_codes_of_equal_gaussians_have_a_finite_gradient():
    model = embedded(2, 3, 4, 2, width=8, neighbours=2)
    entity = Entity(cloud(), model).train()
    entity(Moment(0.3))
    sum(entity.regularizers().values()).backward()
    assert torch.isfinite(model.embedding.grad).all()
