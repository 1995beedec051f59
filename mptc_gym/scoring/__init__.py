"""Let a policy of any form act in environments of any kind: the machinery of `evaluate`.

- `policies` calls a policy as a function of observations.
- `opening` turns environments of any kind into one vector environment of Gymnasium, which is
  made for the policy, or a copy (`copies`) of the environments that a user hands over.
- `fit` refuses environments that a policy was not made for.
- `rollout` steps the vector environment, and checks its episodes.
"""
