"""Names of the files of an exported policy, in the folder of ``pace export`` and in that of a run."""

POLICY_FILE, CONTRACT_FILE = "policy.onnx", "policy.json"
