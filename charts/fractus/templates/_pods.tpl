{{/*
Labels and annotations of the pods of a workload. Argument: (dict "root" $ "part" "agent" "workload" "agent"), that is, the part that
the pods belong to and the workload whose values apply. Labels that policies, selectors and the operator use cannot be set by values,
because a service under another label would lose its protection in flight.
*/}}
{{- define "fractus.podMetadata" -}}
{{- $values := index .root.Values .workload }}
{{- range $name, $_ := $values.podLabels }}
{{- if regexMatch "^(([a-z0-9.-]+[.])?fractus[.]dev|app[.]kubernetes[.]io|helm[.]sh)/|^(controller-revision-hash|pod-template-(hash|generation))$" $name }}
{{- fail (printf "%s.podLabels: the label %s is reserved; use a label with another name" $.workload $name) }}
{{- end }}
{{- end -}}
labels:
  {{- include "fractus.labels" . | nindent 2 }}
  {{- with $values.podLabels }}{{ toYaml . | nindent 2 }}{{ end }}
{{- with $values.podAnnotations }}
annotations: {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}

{{/* Additional environment variables of the container of a workload. Argument: (dict "root" $ "workload" "agent"). */}}
{{- define "fractus.extraEnv" -}}
{{- range (index .root.Values .workload).extraEnv }}
{{- if hasPrefix "FRACTUS_" .name }}
{{- fail (printf "%s.extraEnv: %s is reserved; use the values of the chart instead" $.workload .name) }}
{{- end }}
- {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}

{{/*
Combines required affinities with those of the values. Argument: (dict "ours" DICT "theirs" DICT), in Kubernetes format. Terms that
select nodes are alternatives, so each required term is combined with each term of the values.
*/}}
{{- define "fractus.affinity" -}}
{{- $required := "requiredDuringSchedulingIgnoredDuringExecution" }}
{{- $preferred := "preferredDuringSchedulingIgnoredDuringExecution" }}
{{- $terms := list }}
{{- range $our := dig "nodeAffinity" $required "nodeSelectorTerms" list .ours }}
{{- range $their := dig "nodeAffinity" $required "nodeSelectorTerms" (list dict) $.theirs }}
{{- $joined := concat $our.matchExpressions ($their.matchExpressions | default list) }}
{{- $terms = append $terms (merge (dict "matchExpressions" $joined) $their) }}
{{- end }}
{{- end -}}
nodeAffinity:
  {{ $required }}:
    nodeSelectorTerms: {{- toYaml $terms | nindent 6 }}
  {{- with dig "nodeAffinity" $preferred list .theirs }}
  {{ $preferred }}: {{- toYaml . | nindent 4 }}
  {{- end }}
{{- range $kind := list "podAffinity" "podAntiAffinity" }}
{{- $both := dict }}
{{- range $when := list $required $preferred }}
{{- with concat (dig $kind $when list $.ours) (dig $kind $when list $.theirs) }}{{ $_ := set $both $when . }}{{ end }}
{{- end }}
{{- with $both }}
{{ $kind }}: {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}
{{- end }}

{{/*
Common pod fields on drones and edge nodes. Argument: (dict "root" $ "part" "camera" "classes" (list "drone")). All pods tolerate
every taint and have one PriorityClass, and the policy fractus-pods keeps other pods below it. "graceSeconds" is the time that a pod
needs to stop (default 10).
*/}}
{{- define "fractus.nodePod" -}}
{{- $values := index .root.Values .part -}}
hostNetwork: true
dnsPolicy: Default
enableServiceLinks: false
priorityClassName: {{ .root.Values.priorityClass.name | quote }}
terminationGracePeriodSeconds: {{ .graceSeconds | default 10 }}
affinity:
  {{- $ours := printf `{"key": "fractus.dev/class", "operator": "In", "values": %s}` (toJson .classes) | fromJson }}
  {{- $ours = dict "nodeSelectorTerms" (list (dict "matchExpressions" (list $ours))) }}
  {{- $ours = dict "nodeAffinity" (dict "requiredDuringSchedulingIgnoredDuringExecution" $ours) }}
  {{- include "fractus.affinity" (dict "ours" $ours "theirs" $values.affinity) | nindent 2 }}
{{- with $values.nodeSelector }}
nodeSelector: {{- toYaml . | nindent 2 }}
{{- end }}
# The pods stay on an unreachable drone.
tolerations:
  - operator: Exists
{{ include "fractus.pullSecrets" .root }}
{{- end }}

{{/* Affinity to nodes that are cloud nodes, or neither drones nor edge nodes. Operators are spread over nodes if possible. */}}
{{- define "fractus.cloudAffinity" -}}
nodeAffinity:
  requiredDuringSchedulingIgnoredDuringExecution:
    nodeSelectorTerms:
      - matchExpressions:
          - {key: fractus.dev/class, operator: NotIn, values: [drone, edge]}
      - matchExpressions:
          - {key: fractus.dev/cloud, operator: In, values: ["true"]}
podAntiAffinity:
  preferredDuringSchedulingIgnoredDuringExecution:
    {{- range $key, $weight := dict "kubernetes.io/hostname" 100 "topology.kubernetes.io/zone" 50 }}
    - weight: {{ $weight }}
      podAffinityTerm:
        topologyKey: {{ $key }}
        labelSelector:
          matchLabels: {{- include "fractus.selector" (dict "root" $ "part" "operator") | nindent 12 }}
    {{- end }}
{{- end }}

{{/* Scheduling of the pods of the operator, the view and the management API. Argument: (dict "root" $ "workload" "view"). */}}
{{- define "fractus.cloudPod" -}}
{{- $values := index .root.Values .workload }}
{{- $operator := .root.Values.operator -}}
affinity:
  {{- include "fractus.affinity" (dict "ours" (include "fractus.cloudAffinity" .root | fromYaml) "theirs" $values.affinity) | nindent 2 }}
{{- with $values.nodeSelector | default $operator.nodeSelector }}
nodeSelector: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with $values.tolerations | default $operator.tolerations }}
tolerations: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with $values.topologySpreadConstraints }}
topologySpreadConstraints:
{{- range . }}
{{- $counted := dict "labelSelector" (dict "matchLabels" (include "fractus.selector" (dict "root" $.root "part" $.workload) | fromYaml)) }}
  - {{- toYaml (hasKey . "labelSelector" | ternary . (merge $counted .)) | nindent 4 }}
{{- end }}
{{- end }}
{{- with $values.priorityClassName }}
priorityClassName: {{ . | quote }}
{{- end }}
{{ include "fractus.pullSecrets" .root }}
{{- end }}
