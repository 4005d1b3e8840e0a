// Points of a tracker whose frame is unknown, with Ceres: 21 parameters and the frame (rotation vector, origin), automatic
// differentiation, DENSE_NORMAL_CHOLESKY, problems spread over threads. Input (binary doubles): joints, poses, problems,
// threads; the base arm by kind; index of every free entry; readings; points (3 a pose); starts (27 a problem). Output:
// seconds of solving, then per problem its 27 numbers.
#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <chrono>
#include <fstream>
#include <thread>
#include <vector>

#include "chain.h"

constexpr int kAll = kFree + 6;

struct Residual {
  const Chain* chain;
  const std::vector<double>* points;
  template <typename T>
  bool operator()(const T* all, T* out) const {
    const int m = chain->poses;
    std::vector<T> x(m), y(m), z(m);
    chain->tips(all, x, y, z);
    T matrix[9];  // by columns
    ceres::AngleAxisToRotationMatrix(all + kFree, matrix);
    for (int j = 0; j < m; ++j) {
      const double* p = &(*points)[3 * j];
      const T tip[3] = {x[j], y[j], z[j]};
      for (int c = 0; c < 3; ++c)
        out[3 * j + c] = tip[c] - (matrix[c] * p[0] + matrix[3 + c] * p[1] + matrix[6 + c] * p[2] + all[kFree + 3 + c]);
    }
    return true;
  }
};

int main(int argc, char** argv) {
  if (argc != 3) return 2;
  std::ifstream in(argv[1], std::ios::binary);
  auto read = [&](int count) {
    std::vector<double> values(count);
    in.read(reinterpret_cast<char*>(values.data()), count * sizeof(double));
    return values;
  };
  const auto head = read(4);
  Chain chain;
  chain.joints = static_cast<int>(head[0]);
  chain.poses = static_cast<int>(head[1]);
  const int problems = static_cast<int>(head[2]), threads = static_cast<int>(head[3]);
  chain.base = read(4 * chain.joints + 3);
  for (double s : read(kFree)) chain.slot.push_back(static_cast<int>(s));
  for (double q : read(chain.joints * chain.poses)) {
    chain.cosine.push_back(std::cos(q));
    chain.sine.push_back(std::sin(q));
  }
  const auto points = read(3 * chain.poses);
  auto solutions = read(kAll * problems);
  const auto begin = std::chrono::steady_clock::now();
  std::vector<std::thread> pool;
  for (int t = 0; t < threads; ++t) {
    pool.emplace_back([&, t] {
      for (int k = t; k < problems; k += threads) {
        double* y = &solutions[k * kAll];
        ceres::Problem problem;
        auto* cost = new ceres::AutoDiffCostFunction<Residual, ceres::DYNAMIC, kAll>(
            new Residual{&chain, &points}, 3 * chain.poses);
        problem.AddResidualBlock(cost, nullptr, y);
        ceres::Solver::Options options;
        options.linear_solver_type = ceres::DENSE_NORMAL_CHOLESKY;
        options.num_threads = 1;
        options.max_num_iterations = 200;
        options.function_tolerance = 1e-14;
        options.gradient_tolerance = 1e-14;
        options.parameter_tolerance = 1e-12;
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
}
