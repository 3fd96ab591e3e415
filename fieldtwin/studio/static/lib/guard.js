// What is shown if a view throws an exception. Without it one exception in a drawing would stop all drawings of the page.

import { Component, html } from "../vendor/preact.js";

/** Draw `children`; if one of them throws, draw the error and ways to go on. `place` is the address: another one tries again. */
export class Guard extends Component {
  static getDerivedStateFromError(error) {
    return { error };
  }

  componentDidCatch(error) {
    console.error(error); // with the place in the source, for a report of the defect
  }

  componentDidUpdate(before) {
    if (this.state.error && before.place !== this.props.place) this.setState({ error: null });
  }

  render({ children, title }, { error }) {
    if (!error) return children;
    return html`<section class="card failed" role="alert">
      <h2>${title}</h2>
      <p class="error">${error.message || String(error)}</p>
      <p>This is a defect of Studio. The run and its processes are not affected.</p>
      <p class="bar">
        <button class="primary" onClick=${() => this.setState({ error: null })}>Try again</button>
        <button onClick=${() => location.reload()}>Load the page again</button>
        <a href="/">All instances</a>
      </p>
    </section>`;
  }
}
