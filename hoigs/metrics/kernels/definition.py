"""What SSIM is here: its constants, and its formula as C++ for the kernels (Wang et al. 2004).

The kernels work with p = x + y and d = x - y rather than with the images x and y. From the windowed
means of p, d, p^2 and d^2 (mp, md, pp, dd):

    P = mp^2 / 2    D = md^2 / 2        2 mx my = P - D        mx^2 + my^2 = P + D
    A = (pp - mp^2) / 2                 2 cov(x, y) = A - B
    B = (dd - md^2) / 2                 var(x) + var(y) = A + B

    SSIM = (P - D + C1) / (P + D + C1) * (A - B + C2) / (A + B + C2)

Four blurs, where the five moments of x and y take five, and less rounding: where images agree, d is
small, and an error of A moves numerator and denominator alike. The derivatives hold no differences
of large numbers either.
"""

from __future__ import annotations

import math

WINDOW, SIGMA = 11, 1.5  # Wang et al. 2004, and every Gaussian code base
C1, C2 = 0.01**2, 0.03**2  # for a data range of 1
HALF = WINDOW // 2


def window() -> list[float]:
    """The WINDOW weights of the Gaussian; they sum to 1."""
    weights = [math.exp(-((i - HALF) ** 2) / (2 * SIGMA**2)) for i in range(WINDOW)]
    return [weight / sum(weights) for weight in weights]


# The first HALF + 1 weights; the others mirror them.
WEIGHTS = "{" + ", ".join(f"{weight:.9g}f" for weight in window()[: HALF + 1]) + "}"

# SSIM of one pixel, and of its gradient the three images to blur: with F the blur,
# dSSIM/dx = F(by_mean) + p F(by_sum) + d F(by_difference). For float and for vectors of it.
FORMULA = r"""
    auto similarity = [](auto mp, auto md, auto pp, auto dd,
                         auto& by_mean, auto& by_sum, auto& by_difference) {
        const auto P = 0.5f * mp * mp, D = 0.5f * md * md;
        const auto A = 0.5f * pp - P, B = 0.5f * dd - D;
        const auto light = P + D + C1_, texture = A + B + C2_;
        const auto reciprocal = 1.0f / (light * texture);
        const auto per_light = reciprocal * texture, per_texture = reciprocal * light;
        const auto luminance = (P - D + C1_) * per_light;
        const auto structure = (A - B + C2_) * per_texture;
        const auto by_light = 2.0f * structure * per_light * per_light;
        by_sum = 2.0f * luminance * per_texture * per_texture;
        by_difference = -(A + C2_) * by_sum;
        by_sum = B * by_sum;
        by_mean = mp * (D * by_light - by_sum) - md * ((P + C1_) * by_light + by_difference);
        return luminance * structure;
    };
""".replace("C1_", f"{C1:.9g}f").replace("C2_", f"{C2:.9g}f")
