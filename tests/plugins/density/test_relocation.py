"""One Gaussian as several: the rule of 3DGS-MCMC against integrals, and draws by weight."""

from __future__ import annotations

import math

import pytest
import torch
from density_cases import varied
from scipy.integrate import quad

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.topology import share_opacity
from hoigs.plugins.density.children import Window, drawn_rows
from hoigs.plugins.density.mcmc import MAX_COPIES, relocation_shrink, shared_among
from hoigs.rasterizers.oracle import OracleRasterizer

OPACITIES = (0.01, 0.3, 0.9, 0.999)


@pytest.mark.parametrize("copies", [2, 3, 7, 20, MAX_COPIES])
@pytest.mark.parametrize("opacity", OPACITIES)
def test_the_integral_of_alpha_is_kept(opacity: float, copies: int) -> None:
    shared = 1 - (1 - opacity) ** (1 / copies)
    shrink = float(
        relocation_shrink(torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies]))[0]
    )

    def together(x: float) -> float:  # n coincident splats, front to back
        return 1 - (1 - shared * math.exp(-0.5 * (x / shrink) ** 2)) ** copies

    before = opacity * math.sqrt(2 * math.pi)  # of opacity exp(-x^2 / 2)
    after = 2 * quad(together, 0, 12 * max(1, shrink), epsabs=1e-10, limit=200)[0]
    assert after == pytest.approx(before, rel=1e-6)


@pytest.mark.parametrize("opacity", OPACITIES)
def test_it_is_the_published_double_sum(opacity: float) -> None:
    for copies in (1, 2, 5, 12):
        shared = 1 - (1 - opacity) ** (1 / copies)
        total = sum(
            math.comb(i - 1, k) * (-1) ** k * shared ** (k + 1) / math.sqrt(k + 1)
            for i in range(1, copies + 1)
            for k in range(i)
        )
        found = relocation_shrink(
            torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies])
        )
        assert float(found) == pytest.approx(opacity / total, rel=1e-9)


def test_opacities_are_shared_and_single_rows_left_bit_for_bit() -> None:
    logits = torch.tensor([-12.0, -2.2, 0.0, 3.0, 15.0])
    copies = torch.tensor([2, 3, 1, 5, 51])
    shared = torch.sigmoid(share_opacity(logits, copies).double())
    expected = 1 - (1 - torch.sigmoid(logits.double())) ** (1 / copies)
    torch.testing.assert_close(shared, expected, rtol=1e-5, atol=0)
    assert torch.equal(share_opacity(logits, copies)[2], logits[2])
    keyed = torch.stack((logits, logits + 1), 1)
    torch.testing.assert_close(share_opacity(keyed, copies)[:, 0], share_opacity(logits, copies))


def test_the_picture_stays_where_one_becomes_three() -> None:
    one = varied(1)
    camera = Camera.look_at(
        one.means[0] + torch.tensor([0.0, 0.0, -2.0]), one.means[0], width=32, height=32, fov_y=0.5
    )
    three = shared_among(one[[0, 0, 0]], torch.tensor([3, 3, 3]), 0.005)
    draw = lambda g: OracleRasterizer().render(g, camera, RenderRequest(low_pass=0.0)).alpha  # noqa: E731
    before, after = draw(one), draw(three)
    # eq. 9 keeps a line integral, not every pixel: the middle is exact, the whole is near
    assert float(after.max()) == pytest.approx(float(before.max()), rel=1e-3)
    assert float((after - before).abs().max()) < 0.05 * float(before.max())
    naive = draw(one[[0, 0, 0]])
    assert float((naive - before).abs().max()) > 5 * float((after - before).abs().max())


def test_dividing_leaves_the_rest_of_a_gaussian_alone() -> None:
    canonical = varied(4)
    new = shared_among(canonical, torch.tensor([1, 2, 1, 4]), 0.005)
    for field in ("means", "quats", "sh"):
        assert torch.equal(getattr(new, field), getattr(canonical, field))
    for row in (0, 2):
        assert torch.equal(new.log_scales[row], canonical.log_scales[row])
        assert torch.equal(new.opacity_logits[row], canonical.opacity_logits[row])
    change = new.log_scales - canonical.log_scales  # the shape stays: all three axes alike
    torch.testing.assert_close(change[1], change[1, :1].expand(3))
    faint = shared_among(
        canonical.replace(opacity_logits=torch.full((4,), -5.2)), torch.full((4,), 4), 0.005
    )
    torch.testing.assert_close(faint.opacities, torch.full((4,), 0.005))  # never dead on arrival


def test_rows_are_drawn_by_weight() -> None:
    weights = torch.tensor([0.0, 1.0, 3.0, 0.0, 6.0, 0.0])
    rows = drawn_rows(weights, 20_000, torch.Generator().manual_seed(0))
    shares = torch.bincount(rows, minlength=6) / 20_000
    torch.testing.assert_close(shares, weights / 10, atol=0.012, rtol=0)
    assert (shares[weights == 0] == 0).all()


@pytest.mark.parametrize(
    ("window", "total"),
    [(Window(0.1, 0.5, 100), 1000), (Window(0, 1, 7), 100), (Window(0.9, 1.0, 100), 350),
     (Window(0.02, 0.5, 100), 150), (Window(0.5, 0.2, 10), 1000)],
)  # fmt: skip
def test_refinements_left_are_counted(window: Window, total: int) -> None:
    steps = [s for s in range(1, total + 1) if window.refines(s, total)]
    for step in (1, 2, 99, 100, 101, total):
        assert window.left(step, total) == sum(s >= step for s in steps)
