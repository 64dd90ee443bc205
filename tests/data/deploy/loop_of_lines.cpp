// The C++ loop over lines, for tests: it prints what the graph is given and what the motors get. The outputs of the graph
// stand in the line, so that no runtime is needed. The argument names the interface between lines and loop.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <sstream>
#include <string>

#include "contract.hpp"
#include "onboard/ros2_control.hpp"
#include "onboard/unitree.hpp"

namespace {

// Shapes of unitree_sdk2's messages.
struct MotorState {
  float q_ = 0, dq_ = 0;
  float q() const { return q_; }
  float dq() const { return dq_; }
};
struct ImuState {
  std::array<float, 4> quaternion_{};
  std::array<float, 3> gyroscope_{};
  const std::array<float, 4>& quaternion() const { return quaternion_; }
  const std::array<float, 3>& gyroscope() const { return gyroscope_; }
};
struct LowState {
  std::array<MotorState, 35> motors{};
  ImuState imu;
  const std::array<MotorState, 35>& motor_state() const { return motors; }
  const ImuState& imu_state() const { return imu; }
};
struct MotorCmd {
  std::uint8_t mode_ = 0;
  float q_ = 0, dq_ = 0, kp_ = 0, kd_ = 0, tau_ = 0;
  std::uint8_t& mode() { return mode_; }
  float& q() { return q_; }
  float& dq() { return dq_; }
  float& kp() { return kp_; }
  float& kd() { return kd_; }
  float& tau() { return tau_; }
};
struct LowCmd {
  std::array<MotorCmd, 35> motors{};
  std::array<MotorCmd, 35>& motor_cmd() { return motors; }
};

// Shapes of unitree_legged_sdk's messages.
struct LeggedState {
  struct {
    float q, dq;
  } motorState[20]{};
  struct {
    std::array<float, 4> quaternion;
    std::array<float, 3> gyroscope;
  } imu{};
};
struct LeggedCmd {
  struct {
    std::uint8_t mode;
    float q, dq, tau, Kp, Kd;
  } motorCmd[20]{};
};

// Shapes of ROS messages.
struct Header {
  struct {
    std::int32_t sec;
    std::uint32_t nanosec;
  } stamp{};
};
struct JointState {
  Header header;
  std::vector<std::string> name;
  std::vector<double> position, velocity;
};
struct Imu {
  Header header;
  struct {
    double x, y, z, w;
  } orientation{};
  std::array<double, 9> orientation_covariance{};
  struct {
    double x, y, z;
  } angular_velocity{};
};

class Tokens {
 public:
  explicit Tokens(const std::string& line) : stream_(line) {}
  double number() {
    std::string word;
    stream_ >> word;
    return std::strtod(word.c_str(), nullptr);
  }
  polypod::Numbers numbers(std::size_t count) {
    polypod::Numbers found(count);
    for (double& x : found) x = number();
    return found;
  }
  polypod::Numbers numbers() { return numbers(static_cast<std::size_t>(number())); }

 private:
  std::stringstream stream_;
};

void print(double number) { std::printf(" %.9g", number); }

polypod::Sensors through(const std::string& interface, const polypod::Contract& contract, polypod::Sensors plain) {
  polypod::Sensors found = plain;
  if (interface == "unitree_sdk2") {
    LowState state;
    for (std::size_t m = 0; m < contract.motor_joints.size(); ++m)
      if (const int j = contract.motor_joints[m]; j >= 0) {
        state.motors[m].q_ = static_cast<float>(plain.joint_pos[static_cast<std::size_t>(j)]);
        state.motors[m].dq_ = static_cast<float>(plain.joint_vel[static_cast<std::size_t>(j)]);
      }
    std::copy(plain.quaternion.begin(), plain.quaternion.end(), state.imu.quaternion_.begin());
    std::copy(plain.angular_velocity.begin(), plain.angular_velocity.end(), state.imu.gyroscope_.begin());
    found = polypod::unitree::read(contract, state, plain.time);
  } else if (interface == "unitree_legged_sdk") {
    LeggedState state;
    for (std::size_t m = 0; m < contract.motor_joints.size(); ++m)
      if (const int j = contract.motor_joints[m]; j >= 0) {
        state.motorState[m].q = static_cast<float>(plain.joint_pos[static_cast<std::size_t>(j)]);
        state.motorState[m].dq = static_cast<float>(plain.joint_vel[static_cast<std::size_t>(j)]);
      }
    std::copy(plain.quaternion.begin(), plain.quaternion.end(), state.imu.quaternion.begin());
    std::copy(plain.angular_velocity.begin(), plain.angular_velocity.end(), state.imu.gyroscope.begin());
    found = polypod::unitree::read_legged(contract, state, plain.time);
  } else if (interface == "ros2_control") {
    JointState joints;
    Imu imu;
    joints.header.stamp.sec = static_cast<std::int32_t>(std::floor(plain.time));
    joints.header.stamp.nanosec = static_cast<std::uint32_t>(std::lround(1e9 * (plain.time - std::floor(plain.time))));
    imu.header = joints.header;
    for (std::size_t j = contract.joints.size(); j-- > 0;) {
      joints.name.push_back(contract.joints[j].name);
      joints.position.push_back(plain.joint_pos[j]);
      joints.velocity.push_back(plain.joint_vel[j]);
    }
    imu.orientation = {plain.quaternion[1], plain.quaternion[2], plain.quaternion[3], plain.quaternion[0]};
    imu.angular_velocity = {plain.angular_velocity[0], plain.angular_velocity[1], plain.angular_velocity[2]};
    found = polypod::ros2::read(contract, joints, imu);
  }
  found.linear_velocity = plain.linear_velocity;
  found.height_scan = plain.height_scan;
  return found;
}

void print(const std::string& interface, const polypod::Contract& contract, const polypod::Command& command,
           const polypod::Sensors& sensors) {
  if (interface == "unitree_sdk2") {
    LowCmd message;
    polypod::unitree::write(contract, command, message);
    for (std::size_t m = 0; m < contract.motor_joints.size(); ++m) {
      auto& to = message.motors[m];
      for (const double number : {double(to.mode()), double(to.q()), double(to.dq()), double(to.kp()), double(to.kd())})
        print(number);
      print(to.tau());
    }
  } else if (interface == "unitree_legged_sdk") {
    LeggedCmd message;
    polypod::unitree::write_legged(contract, command, message);
    for (std::size_t m = 0; m < contract.motor_joints.size(); ++m) {
      const auto& to = message.motorCmd[m];
      for (const double number : {double(to.mode), double(to.q), double(to.dq), double(to.Kp), double(to.Kd)}) print(number);
      print(to.tau);
    }
  } else if (interface == "ros2_control") {
    const auto set = [](const std::string&, const std::string&, double value) { print(value); };
    polypod::ros2::write(contract, command, set);
    polypod::ros2::write_efforts(contract, command, sensors, set);
  } else {
    for (std::size_t j = 0; j < command.q.size(); ++j)
      for (const double number : {command.q[j], command.dq[j], command.kp[j], command.kd[j], command.tau[j]}) print(number);
  }
}

}  // namespace

int main(int, char** argv) {
  const std::string interface = argv[1];
  std::vector<float> given;
  const polypod::Network network = [&given](const std::vector<polypod::Floats>&, std::vector<polypod::Floats>& outputs) {
    std::size_t at = 0;
    for (auto& output : outputs)
      for (float& number : output) number = at < given.size() ? given[at++] : 0.0F;
    return true;
  };
  polypod::Loop loop(policy::contract(), network);
  for (std::string line; std::getline(std::cin, line);) {
    if (line == "stand") {
      loop.stand();
    } else if (line == "walk") {
      loop.walk();
    } else if (line == "walk at once") {
      loop.walk(true);
    } else if (line == "damp") {
      loop.damp();
    } else {
      Tokens tokens(line);
      polypod::Sensors sensors;
      const double now = tokens.number();
      sensors.time = tokens.number();
      for (double& x : sensors.quaternion) x = tokens.number();
      for (double& x : sensors.angular_velocity) x = tokens.number();
      sensors.joint_pos = tokens.numbers();
      sensors.joint_vel = tokens.numbers();
      sensors.linear_velocity = tokens.numbers();
      sensors.height_scan = tokens.numbers();
      std::array<double, 3> velocity{};
      for (double& x : velocity) x = tokens.number();
      const auto outputs = tokens.numbers();
      given.assign(outputs.begin(), outputs.end());
      const auto read = through(interface, loop.contract(), sensors);
      const auto command = loop.step(now, read, velocity);
      std::printf("%s %s |", command.mode.c_str(), command.fault.empty() ? "-" : command.fault.c_str());
      for (const auto& input : loop.inputs())
        for (const float number : input) print(number);
      std::printf(" |");
      print(interface, loop.contract(), command, read);
      std::printf("\n");
    }
  }
  return 0;
}
