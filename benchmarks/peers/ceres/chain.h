// The paper's chain with 21 free parameters, for any scalar that Ceres differentiates.
#pragma once

#include <cmath>
#include <vector>

constexpr int kFree = 21;

struct Chain {
  int joints;
  std::vector<double> base;  // alpha, a, d, theta, probe
  std::vector<int> slot;     // of each free entry in base
  std::vector<double> cosine, sine;
  int poses;

  template <typename T>
  void tips(const T* free, std::vector<T>& x, std::vector<T>& y, std::vector<T>& z) const {
    std::vector<T> p(base.begin(), base.end());
    for (int i = 0; i < kFree; ++i) p[slot[i]] = free[i];
    const int n = joints;
    std::vector<T> ct(n), st(n), ca(n), sa(n);
    using std::cos;
    using std::sin;
    for (int i = 0; i < n; ++i) {
      ca[i] = cos(p[i]);
      sa[i] = sin(p[i]);
      ct[i] = cos(p[3 * n + i]);
      st[i] = sin(p[3 * n + i]);
    }
    for (int j = 0; j < poses; ++j) {
      // From the tip back to the base: one point through each joint, the cheapest way to a position.
      T u = p[4 * n], v = p[4 * n + 1], w = p[4 * n + 2];
      for (int i = n - 1; i >= 0; --i) {
        const double cq = cosine[j * n + i], sq = sine[j * n + i];
        T c = cq * ct[i] - sq * st[i], s = sq * ct[i] + cq * st[i];
        T v1 = ca[i] * v - sa[i] * w, w1 = sa[i] * v + ca[i] * w + p[2 * n + i];
        T u1 = u + p[n + i];
        u = c * u1 - s * v1;
        v = s * u1 + c * v1;
        w = w1;
      }
      x[j] = u;
      y[j] = v;
      z[j] = w;
    }
  }
};
