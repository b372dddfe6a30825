// What the kernels of the node for Nuke use of Blink, for a C++ compiler: images of four floats, row 0 at the bottom.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

using std::ceil;
using std::fabs;

struct int2 { int x, y; };
struct float4 {
	float x, y, z, w;
	float4() : x(0), y(0), z(0), w(0) {}
	float4(float a, float b, float c, float d) : x(a), y(b), z(c), w(d) {}
	float4 operator*(float s) const { return float4(x * s, y * s, z * s, w * s); }
	float4 operator*(const float4 &o) const { return float4(x * o.x, y * o.y, z * o.z, w * o.w); }
	float4 operator+(const float4 &o) const { return float4(x + o.x, y + o.y, z + o.z, w + o.w); }
	float4 &operator+=(const float4 &o) { return *this = *this + o; }
};
inline int min(int a, int b) { return a < b ? a : b; }
inline int max(int a, int b) { return a > b ? a : b; }
inline float min(float a, float b) { return a < b ? a : b; }
inline float max(float a, float b) { return a > b ? a : b; }

enum Access { eAccessPoint, eAccessRandom };
enum Mode { eRead, eWrite };
enum Edge { eEdgeNone, eEdgeClamped };
enum Kind { ePixelWise };

struct Bounds {
	int x1, y1, x2, y2;
	int width() const { return x2 - x1; }
	int height() const { return y2 - y1; }
};
int2 here;

struct Held {
	Bounds bounds;
	std::vector<float4> pixels;
	float4 &at(int x, int y) {
		x = min(max(x, 0), bounds.width() - 1);
		y = min(max(y, 0), bounds.height() - 1);
		return pixels[size_t(y) * bounds.width() + x];
	}
};
template <Mode M, Access A = eAccessPoint, Edge E = eEdgeNone> struct Image : Held {
	float4 &operator()() { return at(here.x, here.y); }
	float4 operator()(int x, int y) {
		static_assert(A == eAccessRandom, "an image that is accessed by points has no coordinates");
		return at(x, y);
	}
};
template <Kind K> struct ImageComputationKernel {
	template <class T, class V> void defineParam(T &param, const char *, V value) { param = value; }
};

inline void load(Held &held, const char *path, int width, int height) {
	held.bounds = {0, 0, width, height};
	held.pixels.resize(size_t(width) * height);
	FILE *file = fopen(path, "rb");
	if (!file || fread(held.pixels.data(), sizeof(float4), held.pixels.size(), file) != held.pixels.size()) exit(3);
	fclose(file);
}
inline void save(Held &held, const char *path) {
	FILE *file = fopen(path, "wb");
	if (!file || fwrite(held.pixels.data(), sizeof(float4), held.pixels.size(), file) != held.pixels.size()) exit(4);
	fclose(file);
}
#define kernel struct
#define param public
