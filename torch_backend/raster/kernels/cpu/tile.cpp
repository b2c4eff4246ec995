// Common beginning of both blending stages: access to rows of pixels, and sizes.

const int NCH = @NCH@;
// A tile's row of pixels, `each` floats a pixel: memory beyond the image is neither written nor read; zeros are read.
auto write = FN(float* to, const float* from, int columns, const int each) -> void {
    if (columns == 16) __builtin_memcpy(to, from, 64 * each);
    else for (int i = 0; i < columns * each; i++) to[i] = from[i]; };
auto read = FN(float* to, const float* from, int columns, const int each) -> void {
    if (columns == 16) __builtin_memcpy(to, from, 64 * each);
    else for (int i = 0; i < 16 * each; i++) to[i] = i < columns * each ? from[i] : 0.f; };
const long long RS = P.record_stride, W = P.width, H = P.height, tiles = P.tiles_x * P.tiles_y;
