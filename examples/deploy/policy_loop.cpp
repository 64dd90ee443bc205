// Runs a policy that was exported for one robot: a line of sensors in, a line of commands out, once per control step.
//
//   polypod export --checkpoint flat --robots spot --formats onnx --out exported
//   polypod deploy write exported/policy_spot.onnx --out robot
//   g++ -std=c++17 -O2 policy_loop.cpp -Irobot -I$ONNXRUNTIME/include -L$ONNXRUNTIME/lib -lonnxruntime -o policy_loop
//   ./policy_loop robot/policy_spot.onnx
//
// ONNXRUNTIME is the folder of a release of onnxruntime (https://github.com/microsoft/onnxruntime/releases); Debian's
// package libonnxruntime-dev has the same headers. A line of sensors holds time, quaternion (w, x, y, z), angular
// velocity, joint positions and velocities, the three numbers of the command, then the base's velocity and the height
// scan where the policy observes them. A line of commands holds the mode, the fault or -, then q, kp and kd of each
// joint. An empty line ends the episode. `onboard/unitree.hpp` and `onboard/ros2_control.hpp` take the place of lines.

#include <iostream>
#include <sstream>
#include <string>

#include "contract.hpp"
#include "onboard/onnx_network.hpp"

int main(int argc, char** argv) {
  if (argc != 2) {
    std::cerr << "usage: policy_loop policy_<robot>.onnx\n";
    return 2;
  }
  const polypod::Contract contract = policy::contract();
  try {
    polypod::OnnxNetwork network(contract, argv[1], policy::kContractSha256);
    if (!network.is_its_graph()) {
      std::cerr << argv[1] << " is not the graph of contract.hpp: write both again with polypod deploy write\n";
      return 2;
    }
    polypod::Loop loop(contract, std::ref(network));
    loop.walk(true);
    const auto observes = [&contract](const std::string& name) {
      for (const auto& term : contract.terms)
        for (const auto& input : term.inputs)
          if (input == name) return true;
      return false;
    };
    for (std::string line; std::getline(std::cin, line);) {
      if (line.empty()) {
        loop.walk(true);
        continue;
      }
      std::stringstream numbers(line);
      polypod::Sensors sensors;
      std::array<double, 3> velocity{};
      sensors.joint_pos.resize(contract.joints.size());
      sensors.joint_vel.resize(contract.joints.size());
      if (observes("base_lin_vel")) sensors.linear_velocity.resize(3);
      sensors.height_scan.resize(contract.num_rays);
      numbers >> sensors.time;
      for (double& x : sensors.quaternion) numbers >> x;
      for (double& x : sensors.angular_velocity) numbers >> x;
      for (double& x : sensors.joint_pos) numbers >> x;
      for (double& x : sensors.joint_vel) numbers >> x;
      for (double& x : velocity) numbers >> x;
      for (double& x : sensors.linear_velocity) numbers >> x;
      for (double& x : sensors.height_scan) numbers >> x;
      if (!numbers) {
        std::cerr << "the line has too few numbers\n";
        return 2;
      }
      const polypod::Command command = loop.step(sensors.time, sensors, velocity);
      std::cout << command.mode << ' ' << (command.fault.empty() ? "-" : command.fault);
      for (std::size_t j = 0; j < command.q.size(); ++j)
        std::cout << ' ' << command.q[j] << ' ' << command.kp[j] << ' ' << command.kd[j];
      std::cout << std::endl;
    }
  } catch (const Ort::Exception& error) {
    std::cerr << argv[1] << " is not loaded: " << error.what() << "\n";
    return 2;
  }
  return 0;
}
