{{/*
Labels and annotations of a workload's pods; take (dict "root" $ "part" "agent" "workload" "agent"): the part that the pods are, and
the workload whose values they take. A label by which policies, selectors and the operator go can be no one else's: who could say
that a service is another one would take it from what guards it in flight.
*/}}
{{- define "fractus.podMetadata" -}}
{{- $values := index .root.Values .workload }}
{{- range $name, $_ := $values.podLabels }}
{{- if regexMatch "^(([a-z0-9.-]+[.])?fractus[.]dev|app[.]kubernetes[.]io|helm[.]sh)/|^(controller-revision-hash|pod-template-(hash|generation))$" $name }}
{{- fail (printf "%s.podLabels: policies, selectors or the operator go by %s: use a label of another name" $.workload $name) }}
{{- end }}
{{- end -}}
labels:
  {{- include "fractus.labels" . | nindent 2 }}
  {{- with $values.podLabels }}{{ toYaml . | nindent 2 }}{{ end }}
{{- with $values.podAnnotations }}
annotations: {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}

{{/* Further variables of a workload's container; take (dict "root" $ "workload" "agent"). */}}
{{- define "fractus.extraEnv" -}}
{{- range (index .root.Values .workload).extraEnv }}
{{- if hasPrefix "FRACTUS_" .name }}
{{- fail (printf "%s.extraEnv: %s is the chart's own: set it by its values" $.workload .name) }}
{{- end }}
- {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}

{{/*
Affinities that must hold along with those that are asked for; takes (dict "ours" DICT "theirs" DICT), as pods have them. Terms that
select nodes are alternatives: each of ours is joined with each of theirs.
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
What pods on drones and edge nodes share; take (dict "root" $ "part" "camera" "classes" (list "drone")). All have one PriorityClass,
which the policy fractus-pods keeps others below, and tolerate everything.
*/}}
{{- define "fractus.nodePod" -}}
{{- $values := index .root.Values .part -}}
hostNetwork: true
dnsPolicy: Default
enableServiceLinks: false
priorityClassName: {{ .root.Values.priorityClass.name | quote }}
terminationGracePeriodSeconds: 10
affinity:
  {{- $ours := printf `{"key": "fractus.dev/class", "operator": "In", "values": %s}` (toJson .classes) | fromJson }}
  {{- $ours = dict "nodeSelectorTerms" (list (dict "matchExpressions" (list $ours))) }}
  {{- $ours = dict "nodeAffinity" (dict "requiredDuringSchedulingIgnoredDuringExecution" $ours) }}
  {{- include "fractus.affinity" (dict "ours" $ours "theirs" $values.affinity) | nindent 2 }}
{{- with $values.nodeSelector }}
nodeSelector: {{- toYaml . | nindent 2 }}
{{- end }}
# A drone out of reach keeps what flies it.
tolerations:
  - operator: Exists
{{ include "fractus.pullSecrets" .root }}
{{- end }}

{{/* On nodes that are neither drones nor at the edge, or are of the cloud as well; operators apart from each other where they can. */}}
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

{{/* Where the pods of the operator and of the view run; take (dict "root" $ "workload" "view"). */}}
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
