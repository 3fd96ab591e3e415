// The address of a view: #/INSTANCE/VIEW?what=it&shall=show.

export const address = (instance, view = "overview", query = {}) => {
  const text = new URLSearchParams(query).toString();
  return `#/${encodeURIComponent(instance)}/${view}${text ? `?${text}` : ""}`;
};
