// Runs a policy that was exported for one robot: a line of state in, a line of joint targets out, once per control step.
//
//   polypod export --checkpoint model_280.pt --robots spot --formats onnx --out exported
//   g++ -std=c++17 -O2 policy_loop.cpp -I$ONNXRUNTIME/include -L$ONNXRUNTIME/lib -lonnxruntime -o policy_loop
//   ./policy_loop exported/policy_spot.onnx
//
// ONNXRUNTIME is the folder of a release of onnxruntime (https://github.com/microsoft/onnxruntime/releases); Debian's package
// libonnxruntime-dev has the same headers. Order of joints, gains and control step stand in the file's metadata, under the keys of
// mjlab's exporter. In a controller of ros2_control or a loop of unitree_sdk2, fill `inputs` from the state interfaces or LowState,
// and give `targets` with the gains to the command interfaces or LowCmd. An empty line begins a new episode.

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

namespace {

// One entry of the metadata, such as "joint_names"; empty where there is none.
std::string entry(const Ort::ModelMetadata& metadata, const char* key) {
  Ort::AllocatorWithDefaultOptions allocator;
  auto value = metadata.LookupCustomMetadataMapAllocated(key, allocator);
  return value ? value.get() : "";
}

std::vector<std::string> split(const std::string& text) {
  std::vector<std::string> parts;
  std::stringstream stream(text);
  for (std::string part; std::getline(stream, part, ',');) parts.push_back(part);
  return parts;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) {
    std::cerr << "usage: policy_loop policy_<robot>.onnx\n";
    return 2;
  }
#ifndef _WIN32
  // onnxruntime reports its use to its maker unless this is set before it begins
  setenv("ORT_DISABLE_TELEMETRY", "1", 0);
#endif
  Ort::Env env(ORT_LOGGING_LEVEL_WARNING, "policy_loop");
  Ort::SessionOptions options;
  options.SetIntraOpNumThreads(1);
  Ort::Session session(env, argv[1], options);

  const auto metadata = session.GetModelMetadata();
  const auto joints = split(entry(metadata, "joint_names"));
  const auto stiffness = split(entry(metadata, "joint_stiffness"));
  const auto damping = split(entry(metadata, "joint_damping"));
  if (joints.empty() || stiffness.size() != joints.size() || damping.size() != joints.size()) {
    std::cerr << argv[1] << " is no policy of one robot; export it with --robots\n";
    return 2;
  }
  std::cout << "step_dt " << entry(metadata, "step_dt") << "\njoints";
  for (std::size_t j = 0; j < joints.size(); ++j) std::cout << ' ' << joints[j] << ':' << stiffness[j] << ':' << damping[j];
  std::cout << std::endl;

  // what the policy gives back to itself, zero when an episode begins: its last action, and what it remembers
  std::map<std::string, std::string> fed_back = {{"last_action", "actions"}};
  const auto states = split(entry(metadata, "state_inputs")), after = split(entry(metadata, "state_outputs"));
  for (std::size_t i = 0; i < states.size() && i < after.size(); ++i) fed_back[states[i]] = after[i];

  // names and shapes of the inputs; the robot fills the others in this order
  Ort::AllocatorWithDefaultOptions allocator;
  std::vector<std::string> names;
  std::map<std::string, std::vector<int64_t>> shapes;
  std::map<std::string, std::vector<float>> inputs;
  for (std::size_t i = 0; i < session.GetInputCount(); ++i) {
    names.push_back(session.GetInputNameAllocated(i, allocator).get());
    auto& shape = shapes[names.back()] = session.GetInputTypeInfo(i).GetTensorTypeAndShapeInfo().GetShape();
    std::size_t size = 1;
    for (auto& length : shape) size *= static_cast<std::size_t>(length = length < 0 ? 1 : length);
    inputs[names.back()].assign(size, 0.0F);
  }
  std::vector<const char*> outputs = {"joint_pos_target"};
  std::vector<std::string> returned;
  for (const auto& [input, output] : fed_back)
    if (inputs.count(input)) {
      outputs.push_back(output.c_str());
      returned.push_back(input);
    }

  const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
  for (std::string line; std::getline(std::cin, line);) {
    if (line.empty()) {
      for (const auto& input : returned) inputs[input].assign(inputs[input].size(), 0.0F);
      continue;
    }
    std::stringstream state(line);
    std::vector<const char*> keys;
    std::vector<Ort::Value> values;
    for (const auto& name : names) {
      auto& numbers = inputs[name];
      if (!fed_back.count(name))
        for (float& number : numbers)
          if (!(state >> number)) {
            std::cerr << "the state has too few numbers for " << name << "\n";
            return 2;
          }
      const auto& shape = shapes[name];
      keys.push_back(name.c_str());
      values.push_back(Ort::Value::CreateTensor<float>(memory, numbers.data(), numbers.size(), shape.data(), shape.size()));
    }
    auto results =
        session.Run(Ort::RunOptions{nullptr}, keys.data(), values.data(), values.size(), outputs.data(), outputs.size());
    const float* targets = results[0].GetTensorData<float>();
    for (std::size_t j = 0; j < joints.size(); ++j) std::cout << (j ? " " : "") << targets[j];
    std::cout << std::endl;
    for (std::size_t i = 0; i < returned.size(); ++i) {
      const float* output = results[1 + i].GetTensorData<float>();
      std::copy_n(output, inputs[returned[i]].size(), inputs[returned[i]].begin());
    }
  }
  return 0;
}
