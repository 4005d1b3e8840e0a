// Stage 1 of the paper's problem with Ceres: automatic differentiation, bounds, DENSE_NORMAL_CHOLESKY, one problem after
// another, spread over threads. Input (binary doubles): joints, poses, problems, threads, held entry (-1: none); the base
// arm by kind (alpha, a, d, theta: n each; probe: 3); kind and index of every free entry; readings; lower; upper; starts.
// Output: seconds of solving, then per problem its parameters and DE.
#include <ceres/ceres.h>

#include "chain.h"

#include <chrono>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <thread>
#include <vector>

struct Residual {
  const Chain* chain;
  template <typename T>
  bool operator()(const T* free, T* out) const {
    const int m = chain->poses;
    std::vector<T> x(m), y(m), z(m);
    chain->tips(free, x, y, z);
    T mx(0), my(0), mz(0);
    for (int j = 0; j < m; ++j) {
      mx += x[j];
      my += y[j];
      mz += z[j];
    }
    const double share = 1.0 / m;
    mx *= T(share);
    my *= T(share);
    mz *= T(share);
    for (int j = 0; j < m; ++j) {
      out[3 * j] = x[j] - mx;
      out[3 * j + 1] = y[j] - my;
      out[3 * j + 2] = z[j] - mz;
    }
    return true;
  }
};

double de(const Chain& chain, const double* free) {
  const int m = chain.poses;
  std::vector<double> out(3 * m);
  Residual{&chain}(free, out.data());
  double sum = 0;
  for (int j = 0; j < m; ++j) sum += std::sqrt(out[3 * j] * out[3 * j] + out[3 * j + 1] * out[3 * j + 1] + out[3 * j + 2] * out[3 * j + 2]);
  return sum / m;
}

int main(int argc, char** argv) {
  if (argc != 3) return 2;
  std::ifstream in(argv[1], std::ios::binary);
  auto read = [&](int count) {
    std::vector<double> values(count);
    in.read(reinterpret_cast<char*>(values.data()), count * sizeof(double));
    return values;
  };
  const auto head = read(5);
  Chain chain;
  chain.joints = static_cast<int>(head[0]);
  chain.poses = static_cast<int>(head[1]);
  const int problems = static_cast<int>(head[2]), threads = static_cast<int>(head[3]), held = static_cast<int>(head[4]);
  chain.base = read(4 * chain.joints + 3);
  for (double s : read(kFree)) chain.slot.push_back(static_cast<int>(s));
  for (double q : read(chain.joints * chain.poses)) {
    chain.cosine.push_back(std::cos(q));
    chain.sine.push_back(std::sin(q));
  }
  const auto lower = read(kFree), upper = read(kFree);
  auto solutions = read(kFree * problems);

  const auto begin = std::chrono::steady_clock::now();
  std::vector<std::thread> pool;
  for (int t = 0; t < threads; ++t) {
    pool.emplace_back([&, t] {
      for (int k = t; k < problems; k += threads) {
        double* y = &solutions[k * kFree];
        ceres::Problem problem;
        auto* cost = new ceres::AutoDiffCostFunction<Residual, ceres::DYNAMIC, kFree>(new Residual{&chain}, 3 * chain.poses);
        problem.AddResidualBlock(cost, nullptr, y);
        for (int i = 0; i < kFree; ++i) {
          problem.SetParameterLowerBound(y, i, lower[i]);
          problem.SetParameterUpperBound(y, i, upper[i]);
        }
        if (held >= 0) problem.SetManifold(y, new ceres::SubsetManifold(kFree, {held}));
        ceres::Solver::Options options;
        options.linear_solver_type = ceres::DENSE_NORMAL_CHOLESKY;
        options.num_threads = 1;
        options.max_num_iterations = 200;
        options.function_tolerance = 1e-30;
        options.gradient_tolerance = 1e-14;
        options.parameter_tolerance = 1e-13;
        options.logging_type = ceres::SILENT;
        ceres::Solver::Summary summary;
        ceres::Solve(options, &problem, &summary);
      }
    });
  }
  for (auto& thread : pool) thread.join();
  const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();

  std::ofstream out(argv[2], std::ios::binary);
  out.write(reinterpret_cast<const char*>(&seconds), sizeof(double));
  out.write(reinterpret_cast<const char*>(solutions.data()), solutions.size() * sizeof(double));
  for (int k = 0; k < problems; ++k) {
    const double d = de(chain, &solutions[k * kFree]);
    out.write(reinterpret_cast<const char*>(&d), sizeof(double));
  }
  return 0;
}
