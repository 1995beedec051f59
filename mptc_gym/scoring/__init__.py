"""Let a policy of any form act in environments of any kind: the machinery of `evaluate`.

- `policies` calls a policy as a function of observations.
- `opening` turns environments of any kind into one vector environment of Gymnasium, which is
  made for the policy, or is a copy of the environments that a user passes. `copies` copies
  environments.
- `fit` refuses environments that a policy was not trained or made for.
- `rollout` steps the vector environment, and checks that its episodes are those of the seeds.
"""
