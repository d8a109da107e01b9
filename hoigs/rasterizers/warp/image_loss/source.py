"""C++ of the image loss's kernels; the stages are those of SSIM (`warp.ssim.tile_source`).

Lines of render, frame, masks and gradient are `stride` numbers apart, since all are boxes of larger
images; arrays begin at the box's first pixel. Where a pixel is ignored the render is replaced by
the target, so that it has neither a loss nor a gradient.
"""

from hoigs.rasterizers.warp.ssim.tile_source import backward, forward

_FETCH = """
            const long long at = (long long)y * render_stride + x * channels + channel;
            const long long masked = (long long)y * mask_stride + x;
            b = ((const unsigned char*)pixels.data)[(long long)y * pixel_stride + x * channels
                                                    + channel] / 255.0f;
            if (with_shown && !((const unsigned char*)shown.data)[masked])
                b = ((const float*)background.data)[channel];
            const bool hidden = with_ignored && ((const unsigned char*)ignored.data)[masked];
            a = hidden ? b : ((const float*)render.data)[at];
"""
# in[1] holds image - target of the tile and 5 pixels around it
_PIXEL = """
            const float difference = in[1][top + j + 5][c + 5];
            sum += l1_weight * fabsf(difference) + dssim_weight / (float)numbers * (1.0f - value);
"""
_GRADIENT = """
            const float sign = a > b ? 1.0f : (a < b ? -1.0f : 0.0f);
            float value = l1_weight * sign - dssim_weight / (float)numbers * slope;
            value = hidden ? 0.0f : scale * value;
            float* into = (float*)gradient.data + (long long)y * gradient_stride + x * channels
                          + channel;
            *into = add ? *into + value : value;
"""

FORWARD = forward(_FETCH, _PIXEL)
BACKWARD = backward(_FETCH, _GRADIENT)
